"""The command line. Imports late, so that `--help` answers at once."""
