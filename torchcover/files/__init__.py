"""What every reader of a file shares."""

from torchcover.files.yaml_text import parse_yaml

__all__ = ["parse_yaml"]
