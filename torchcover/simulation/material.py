"""What surfaces are made of, as far as a LiDAR can tell."""

from functools import cache
from threading import Lock
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, NonNegativeFloat

from torchcover.geometry.arrays import Float32
from torchcover.simulation.builtin import builtin_names
from torchcover.simulation.documents import BuiltIn

# What nobody said the material of is scenery: walls for the most part.
UNSAID = "brick"
# Materials from files that were met so far, in this process, and how many there may be for numbers of one byte.
_FROM_FILES: list["Material"] = []
_LOCK = Lock()
MOST = 255
# A body has its own tone, the same at every time and for every rig: that of its number among so many.
TONES = np.append(np.random.default_rng(905).standard_normal(4095), 0.0).astype(np.float32)


def _reflecting(given: Any) -> Any:  # noqa: ANN401  (whatever stood in the file)
    if given != "retroreflective" and not (type(given) in (int, float) and 0.0 <= given <= 1.0):
        raise ValueError(f"a share of light from 0 to 1, or `retroreflective`, is needed; got {given!r:.60}")
    return given


class Material(BuiltIn):
    """A surface, as light of 905 nm meets it.

    Args:
        name: What a body's `material` calls it.
        description: What it is, and where its numbers come from.
        reflectivity: Share of light that a white, rough surface would return, 0 to 1: the median. `retroreflective`:
            it sends light back to where it came from, and always returns.
        incidence_exponent: k; what returns falls as the cosine of the incidence to the power of k. 1 is Lambert's law.
        spread: Standard deviation of ln reflectivity.
        varies_by: Whether that is between places, drawn for each ray, or between bodies, so that a dark one is dark all
            over.

    Example:
        >>> Material.load("road").incidence_exponent
        0.2
    """

    folder: ClassVar[str] = "materials"

    name: str
    description: str = ""
    reflectivity: Annotated[float | Literal["retroreflective"], BeforeValidator(_reflecting)]
    incidence_exponent: NonNegativeFloat = 1.0
    spread: NonNegativeFloat = 0.0
    varies_by: Literal["place", "body"] = "place"

    @property
    def share(self) -> float:
        """The reflectivity as a number: infinite for a retroreflector."""
        return np.inf if self.reflectivity == "retroreflective" else float(self.reflectivity)


class Materials(NamedTuple):
    """What all materials are, by number: `reflectivity`, `exponent`, and `spread` of ln reflectivity by what varies."""

    reflectivity: Float32
    exponent: Float32
    spread_of_places: Float32
    spread_of_bodies: Float32


def material_number(name: str) -> int:
    """The number of a material by name or YAML file, which meshes have in this process; 0 is where none was said.

    FileNotFoundError: there is none; the message lists those that there are. ValueError: a file that is not valid, or
    more materials than there are numbers.
    """
    known = _builtin_numbers()
    if name in known:
        return known[name]
    own = Material.load(name)
    with _LOCK:
        if own not in _FROM_FILES:
            if len(known) + len(_FROM_FILES) == MOST:
                raise ValueError(f"{name}: {MOST} materials are too many already")
            _FROM_FILES.append(own)
            materials.cache_clear()
        return 1 + len(known) + _FROM_FILES.index(own)


@cache
def _builtin_numbers() -> dict[str, int]:
    return {name: number for number, name in enumerate(builtin_names("materials"), 1)}


@cache
def materials() -> Materials:
    """All materials by their numbers."""
    each = [Material.load(name) for name in (UNSAID, *builtin_names("materials"))] + _FROM_FILES
    of_body = [one.spread if one.varies_by == "body" else 0.0 for one in each]
    of_place = [one.spread - spread for one, spread in zip(each, of_body, strict=True)]
    columns = ([one.share for one in each], [one.incidence_exponent for one in each], of_place, of_body)
    return Materials._make(np.array(column, dtype=np.float32) for column in columns)


def tone(body: NDArray[np.integer]) -> Float32:
    """(N,) by how many spreads each body is brighter than its material, by its number; 0 for what is no body, -1."""
    return np.asarray(TONES[body % len(TONES)])
