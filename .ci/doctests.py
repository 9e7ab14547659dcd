"""An extension of griffe, which reads docstrings for the site: `Example:` is code, as `Examples:` is to it."""

import re

import griffe


class Doctests(griffe.Extension):
    """Its parser takes what stands under another title for Markdown, in which lists become links."""

    def on_instance(self, *, obj, **_):
        """Rename the title where there is one."""
        if obj.docstring:
            obj.docstring.value = re.sub(r"(?m)^Example:$", "Examples:", obj.docstring.value)
