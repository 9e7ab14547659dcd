"""The metrics of others, by the names that `torchcover compare --metrics` takes."""

from collections.abc import Mapping

from torchcover.published.setup import Published

PUBLISHED: Mapping[str, Published] = {}
