"""One file a family of formats; `readers` holds the registry and names the file in every error."""
