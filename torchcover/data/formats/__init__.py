"""One file a family of formats; `torchcover.data.clouds` holds the registry and names the file in every error."""
