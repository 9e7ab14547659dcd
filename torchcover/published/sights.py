"""What several metrics ask of the same frame and rig, found once."""

from torchcover.data import Frame


class Sights:
    """Remembers what was found in the last frame. Several metrics of a run share one; a copy starts anew."""

    def __init__(self) -> None:
        self._frame: Frame | None = None

    def __reduce__(self) -> tuple[type["Sights"], tuple[()]]:
        return Sights, ()
