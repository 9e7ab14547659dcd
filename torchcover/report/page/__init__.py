"""Page of a run in one HTML file: tables, interactive maps, the rigs, and the origin of the numbers."""
