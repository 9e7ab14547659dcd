"""The error of one frame among others that are good."""

import re


class BadFrameError(ValueError):
    """One frame of a recording cannot be used; the others can.

    `name` and `index` say which frame. A caller that skips bad frames catches this around `next`, with and without
    worker processes.

    Args:
        message: `NAME (frame INDEX): reason`, or a worker's traceback that ends in it: DataLoader knows no other way to
            build an exception again than from its text.

    Example:
        >>> error = BadFrameError("night_7 (frame 6): the reference cloud has no points")
        >>> error.name, error.index
        ('night_7', 6)
    """

    def __init__(self, message: str) -> None:
        super().__init__(message.rpartition("BadFrameError: ")[2].strip())
        parts = re.match(r"(?P<name>.*?) \(frame (?P<index>\d+)\): ", str(self))
        self.name = parts["name"] if parts else ""
        self.index = int(parts["index"]) if parts else -1
