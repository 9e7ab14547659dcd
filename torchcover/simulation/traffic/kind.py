"""What a scenario asks of its traffic, be it made or recorded."""

from abc import abstractmethod
from typing import Annotated, ClassVar

from pydantic import Field

from torchcover.simulation.documents import Document
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.world import World

MIN_TIME_STEP_S = 0.01


class Traffic(Document):
    """What makes a world with an ego in it, and says how long a run through it is.

    Args:
        time_step_s: Time between two frames.
    """

    # Whether a run is followed by the same again, which says nothing new, or by another world.
    repeats: ClassVar[bool]

    time_step_s: Annotated[float, Field(ge=MIN_TIME_STEP_S)] = 0.1

    @property
    def drawn_words(self) -> str:
        """What of a recording was not recorded, for results; no words where all is drawn, or nothing."""
        return ""

    @property
    @abstractmethod
    def steps(self) -> int:
        """Number of instants of a run."""

    def check(self) -> None:
        """Find out before a run whether a world can be built; ImportError if something is not installed."""

    @abstractmethod
    def world(self, seed: int, ego: Mesh | None = None) -> World:
        """Build the world; the same for the same seed of whatever is drawn, and ego, the built-in SUV if not given."""
