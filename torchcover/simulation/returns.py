"""What comes back from a hit: materials, weather, and whether there is a return.

The range equation has the two numbers of a data sheet, and a material. A target wider than the beam sends back power in
proportion to q = (rho / 0.1) cos(incidence)^k exp(-2 alpha R) (R10 / R)^2, scaled so that q = 1 is just enough at the
range R10 that data sheets give for a reflectivity rho of 10 %. What is enough differs from pulse to pulse:
P(return) = p0 Phi(ln q / (2 s)), where s spreads the range.
"""

from functools import cache
from threading import Lock
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BeforeValidator, NonNegativeFloat, PositiveFloat

from torchcover.geometry.arrays import Float32
from torchcover.simulation.builtin import list_builtin_names
from torchcover.simulation.documents import BuiltInDocument

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


class Material(BuiltInDocument):
    """A surface, as light of 905 nm meets it.

    Args:
        name: What a body's `material` calls it.
        description: What it is, and where its numbers come from.
        reflectivity: Share of light that a white, rough surface would return, 0 to 1: the median. `retroreflective`:
            it sends light back to where it came from, and always returns.
        incidence_exponent: k; what returns falls as the cosine of the incidence to the power of k. 1 is Lambert's law.
        log_reflectivity_std: Standard deviation of ln reflectivity.
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
    log_reflectivity_std: NonNegativeFloat = 0.0
    varies_by: Literal["place", "body"] = "place"

    @property
    def numeric_reflectivity(self) -> float:
        """The reflectivity as a number: infinite for a retroreflector."""
        return np.inf if self.reflectivity == "retroreflective" else float(self.reflectivity)


class MaterialTable(NamedTuple):
    """What all materials are, by number: `reflectivity`, `incidence_exponent`, and `spread` of ln reflectivity by what varies."""

    reflectivity: Float32
    incidence_exponent: Float32
    point_log_std: Float32
    body_log_std: Float32


def get_material_index(material_name: str) -> int:
    """The number of a material by name or YAML file, which meshes have in this process; 0 is where none was said.

    FileNotFoundError: there is none; the message lists those that there are. ValueError: a file that is not valid, or
    more materials than there are numbers.
    """
    known = _builtin_numbers()
    if material_name in known:
        return known[material_name]
    own = Material.load(material_name)
    with _LOCK:
        if own not in _FROM_FILES:
            if len(known) + len(_FROM_FILES) == MOST:
                raise ValueError(f"{material_name}: {MOST} materials are too many already")
            _FROM_FILES.append(own)
            load_materials.cache_clear()
        return 1 + len(known) + _FROM_FILES.index(own)


@cache
def _builtin_numbers() -> dict[str, int]:
    return {name: number for number, name in enumerate(list_builtin_names("materials"), 1)}


@cache
def load_materials() -> MaterialTable:
    """All materials by their numbers."""
    each = [Material.load(name) for name in (UNSAID, *list_builtin_names("materials"))] + _FROM_FILES
    of_body = [one.log_reflectivity_std if one.varies_by == "body" else 0.0 for one in each]
    of_place = [one.log_reflectivity_std - spread for one, spread in zip(each, of_body, strict=True)]
    columns = ([one.numeric_reflectivity for one in each], [one.incidence_exponent for one in each], of_place, of_body)
    return MaterialTable._make(np.array(column, dtype=np.float32) for column in columns)


def compute_brightness_offsets(body_indices: NDArray[np.integer]) -> Float32:
    """(N,) by how many spreads each body is brighter than its material, by its number; 0 for what is no body, -1."""
    return np.asarray(TONES[body_indices % len(TONES)])


Floats = NDArray[np.floating]

# Of the strongest returns as many come back: 98 to 99 % of near road in sweeps of VLP-32C, HDL-32E and HDL-64E.
SURE = 0.985
# Contrast of 5 % (Koschmieder 1924, and the meteorological optical range since): visibility = ln(20) / alpha.
LN_20 = float(np.log(20.0))
# No face is met at a smaller cosine: float32 leaves open what it would be.
LEAST_COSINE = 1e-4


def compute_log_excess(
    range_m: float | Floats,
    cos_incidence: float | Floats,
    reflectivity: float | Floats,
    incidence_exponent: float | Floats,
    range_at_10_percent_m: float | Floats,
    extinction_per_m: float = 0.0,
) -> Floats:
    """(N,) ln q of N hits, above 0 where what comes back is more than enough.

    In the type of the ranges: logarithms of float32 are good to 1e-6. The reflectivity is from 0 to 1, infinite for a
    retroreflector, the exponent k of the cosine of the incidence 1 for Lambert's law. At the range that is given, a
    reflectivity of 10 % met head-on is just enough; the air's extinction is alpha, one way.
    """
    with np.errstate(divide="ignore"):  # of what reflects nothing: minus infinity
        excess: Floats = np.log(np.asarray(reflectivity) / 0.1)
    excess = excess + incidence_exponent * np.log(np.maximum(cos_incidence, LEAST_COSINE))
    excess = excess + 2.0 * np.log(range_at_10_percent_m / range_m)
    return excess - 2.0 * extinction_per_m * range_m if extinction_per_m else excess


def compute_return_probability(
    log_excess: float | Floats, log_range_std: float | Floats, log_reflectivity_std: float | Floats = 0.0
) -> Floats:
    """(N,) P(return) of hits with (N,) ln q, `log_range_std` the standard deviation of ln range of the sensor.

    `log_reflectivity_std` (N,) is that of ln reflectivity between places of the material.
    """
    sigmas = np.asarray(log_excess / np.hypot(2.0 * np.asarray(log_range_std), log_reflectivity_std))
    return np.asarray(SURE * torch.special.ndtr(torch.from_numpy(sigmas)).numpy())


def compute_extinction_per_m(visibility_m: float | None, rain_mm_h: float = 0.0) -> float:
    """Extinction of light of 905 nm in air, one way: of fog by Koschmieder's law, if there is any, and of rain.

    Rain: 1.076 R^0.67 dB/km, R in mm/h (Carbonneau & Wisely 1998, Proc. SPIE 3232).
    """
    decibels_per_km = 1.076 * rain_mm_h**0.67
    of_rain = decibels_per_km * np.log(10.0) / 10.0 / 1e3
    return float(of_rain + (0.0 if visibility_m is None else LN_20 / visibility_m))


class Weather(BuiltInDocument):
    """What the air and the road are like.

    Args:
        name: What tables call it.
        description: What it is, and where its numbers come from.
        visibility_m: How far one sees in fog: the meteorological optical range, 5 % of contrast. None if it is clear.
        rain_mm_h: Rate of the rain.
        road: A wet one mirrors light ahead, as the material `wet_road`.

    Example:
        >>> Weather.load("fog_100m").extinction_per_m > Weather.load("rain_50mm_h").extinction_per_m
        True
    """

    folder: ClassVar[str] = "weather"

    name: str = "weather"
    description: str = ""
    visibility_m: PositiveFloat | None = None
    rain_mm_h: NonNegativeFloat = 0.0
    road: Literal["dry", "wet"] = "dry"

    @property
    def extinction_per_m(self) -> float:
        """Of light on its way through the air, one way."""
        return compute_extinction_per_m(self.visibility_m, self.rain_mm_h)


CLEAR = Weather(name="clear")
