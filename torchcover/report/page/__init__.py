"""One file that shows a run in any browser: tables, maps to look into, the rig, and where the numbers come from."""
