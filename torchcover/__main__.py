"""`python -m torchcover`: the command line."""

from torchcover.cli.app import main

main()
