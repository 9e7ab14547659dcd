"""Where placement looks for what writes a folder."""

from torchcover.files import SUMMARY, claimed
from torchcover.files import Publication as ResultFiles

__all__ = ["SUMMARY", "ResultFiles", "claimed"]
