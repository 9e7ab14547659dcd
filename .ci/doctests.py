"""Griffe extension: reads the section `Example:` of docstrings as `Examples:`, whose content is code."""

import re

import griffe


class Doctests(griffe.Extension):
    """Renames the section; Griffe parses the content of other sections as Markdown, in which lists become links."""

    def on_instance(self, *, obj, **_):
        """Rename the section in the docstring of an object."""
        if obj.docstring:
            obj.docstring.value = re.sub(r"(?m)^Example:$", "Examples:", obj.docstring.value)
