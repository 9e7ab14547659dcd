"""Where `ResultFiles` was looked for."""

from torchcover.files import SUMMARY, claimed
from torchcover.files import Publication as ResultFiles

__all__ = ["SUMMARY", "ResultFiles", "claimed"]
