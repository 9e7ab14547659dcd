"""Returns of LiDAR rays: materials, weather, and the probability that a hit returns.

The range equation uses two numbers of a data sheet and a material. A target wider than the beam returns power in
proportion to q = (rho / 0.1) cos(incidence)^k exp(-2 alpha R) (R10 / R)^2, scaled so that q = 1 is the detection
threshold at the range R10 that data sheets give for a reflectivity rho of 10 %. The threshold varies from pulse to
pulse: P(return) = p0 Phi(ln q / (2 s)), with the standard deviation s of ln range.
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

# Materials from user files that this process has loaded; their indices follow the built-in materials.
_USER_MATERIALS: list["Material"] = []
_LOCK = Lock()
# Brightness offset of a body relative to its material, in standard deviations, indexed by body index modulo 4096. It is
# the same in all frames and for all rigs. The last entry serves index -1 (no body).
BRIGHTNESS_OFFSETS = np.append(np.random.default_rng(905).standard_normal(4095), 0.0).astype(np.float32)
# P(return) of the strongest returns: 98 to 99 % of near road in scans of VLP-32C, HDL-32E and HDL-64E.
MAX_RETURN_PROBABILITY = 0.985


def _check_reflectivity(value: Any) -> Any:  # noqa: ANN401  (raw content of a file)
    if value != "retroreflective" and not (type(value) in (int, float) and 0.0 <= value <= 1.0):
        raise ValueError(f"a share of light from 0 to 1, or `retroreflective`, is needed; got {value!r:.60}")
    return value


class Material(BuiltInDocument):
    """Surface with its optical properties at 905 nm.

    Args:
        name: Name that `material` of a body refers to.
        description: Surface and source of the numbers.
        reflectivity: Median share of light that the surface reflects, relative to a white Lambertian surface, 0 to 1;
            `retroreflective` for a surface that always returns light to its source.
        incidence_exponent: Exponent k of the cosine of the incidence angle; 1 is Lambert's law.
        log_reflectivity_std: Standard deviation of ln reflectivity.
        varies_by: `point` samples the reflectivity for each ray, `body` once for each body.

    Example:
        >>> Material.load("road").incidence_exponent
        0.2
    """

    folder: ClassVar[str] = "materials"

    name: str
    description: str = ""
    reflectivity: Annotated[float | Literal["retroreflective"], BeforeValidator(_check_reflectivity)]
    incidence_exponent: NonNegativeFloat = 1.0
    log_reflectivity_std: NonNegativeFloat = 0.0
    varies_by: Literal["point", "body"] = "point"

    @property
    def numeric_reflectivity(self) -> float:
        """Reflectivity as a number; infinite for a retroreflector."""
        return np.inf if self.reflectivity == "retroreflective" else float(self.reflectivity)


class MaterialTable(NamedTuple):
    """Properties of all M materials, indexed by material index.

    Args:
        reflectivity: (M,) median reflectivity.
        incidence_exponent: (M,) exponent of the cosine of the incidence angle.
        point_log_std: (M,) standard deviation of ln reflectivity between points; 0 if it varies by body.
        body_log_std: (M,) standard deviation of ln reflectivity between bodies; 0 if it varies by point.
    """

    reflectivity: Float32
    incidence_exponent: Float32
    point_log_std: Float32
    body_log_std: Float32


def get_material_index(material_name: str) -> int:
    """Look up the index of a material, which is valid in this process; 0 stands for an unspecified material.

    Args:
        material_name: Name of a built-in material or path of a YAML file.

    Raises:
        FileNotFoundError: No such material; the message lists the built-in ones.
        ValueError: The file is not valid, or there are more materials than indices of one byte.
    """
    builtin_indices = _index_builtin_materials()
    if material_name in builtin_indices:
        return builtin_indices[material_name]
    material = Material.load(material_name)
    max_materials = 255
    with _LOCK:
        if material not in _USER_MATERIALS:
            if len(builtin_indices) + len(_USER_MATERIALS) == max_materials:
                raise ValueError(f"{material_name}: at most {max_materials} materials are possible; use fewer")
            _USER_MATERIALS.append(material)
            load_materials.cache_clear()
        return 1 + len(builtin_indices) + _USER_MATERIALS.index(material)


@cache
def _index_builtin_materials() -> dict[str, int]:
    return {name: index for index, name in enumerate(list_builtin_names("materials"), 1)}


@cache
def load_materials() -> MaterialTable:
    """Load the properties of all materials; an unspecified material (index 0) is brick, as most walls."""
    materials = [Material.load(name) for name in ("brick", *list_builtin_names("materials"))] + _USER_MATERIALS
    log_std = np.array([material.log_reflectivity_std for material in materials])
    varies_by_body = np.array([material.varies_by == "body" for material in materials])
    return MaterialTable(
        reflectivity=np.array([material.numeric_reflectivity for material in materials], dtype=np.float32),
        incidence_exponent=np.array([material.incidence_exponent for material in materials], dtype=np.float32),
        point_log_std=np.where(varies_by_body, 0.0, log_std).astype(np.float32),
        body_log_std=np.where(varies_by_body, log_std, 0.0).astype(np.float32),
    )


def compute_brightness_offsets(body_indices: NDArray[np.integer]) -> Float32:
    """Compute how much brighter bodies are than the median of their material.

    Args:
        body_indices: (N,) body of each hit; -1 for no body.

    Returns:
        (N,) offsets in standard deviations of ln reflectivity; 0 for no body.
    """
    return np.asarray(BRIGHTNESS_OFFSETS[body_indices % len(BRIGHTNESS_OFFSETS)])


Floats = NDArray[np.floating]


def compute_log_excess(
    range_m: float | Floats,
    cos_incidence: float | Floats,
    reflectivity: float | Floats,
    incidence_exponent: float | Floats,
    range_at_10_percent_m: float | Floats,
    extinction_per_m: float = 0.0,
) -> Floats:
    """Compute ln q of N hits: the logarithm of the returned power relative to the detection threshold.

    Args:
        range_m: (N,) range; its dtype is that of the result (logarithms of float32 have errors of 1e-6).
        cos_incidence: (N,) cosine of the incidence angle.
        reflectivity: (N,) reflectivity from 0 to 1; infinite for a retroreflector.
        incidence_exponent: (N,) exponent k of the cosine; 1 for Lambert's law.
        range_at_10_percent_m: (N,) range at which 10 % reflectivity at normal incidence reaches the threshold.
        extinction_per_m: One-way extinction coefficient alpha of the air.

    Returns:
        (N,) ln q; positive above the threshold, minus infinity for reflectivity 0.
    """
    min_cosine = 1e-4  # smaller cosines are rounding errors of float32
    with np.errstate(divide="ignore"):  # reflectivity 0 gives minus infinity
        log_excess: Floats = np.log(np.asarray(reflectivity) / 0.1)
    log_excess = log_excess + incidence_exponent * np.log(np.maximum(cos_incidence, min_cosine))
    log_excess = log_excess + 2.0 * np.log(range_at_10_percent_m / range_m)
    return log_excess - 2.0 * extinction_per_m * range_m if extinction_per_m else log_excess


def compute_return_probability(
    log_excess: float | Floats, log_range_std: float | Floats, log_reflectivity_std: float | Floats = 0.0
) -> Floats:
    """Compute P(return) of hits.

    Args:
        log_excess: (N,) ln q of the hits, see `compute_log_excess`.
        log_range_std: Standard deviation of ln range of the sensor.
        log_reflectivity_std: (N,) standard deviation of ln reflectivity between points of the material.

    Returns:
        (N,) probabilities, at most 0.985.
    """
    sigmas = np.asarray(log_excess / np.hypot(2.0 * np.asarray(log_range_std), log_reflectivity_std))
    return np.asarray(MAX_RETURN_PROBABILITY * torch.special.ndtr(torch.from_numpy(sigmas)).numpy())


def compute_extinction_per_m(visibility_m: float | None, rain_mm_h: float = 0.0) -> float:
    """Compute the one-way extinction coefficient of air at 905 nm.

    Fog: Koschmieder's law (1924) with a contrast of 5 %, alpha = ln(20) / visibility. Rain: 1.076 R^0.67 dB/km with R
    in mm/h (Carbonneau & Wisely 1998, Proc. SPIE 3232).

    Args:
        visibility_m: Meteorological optical range; None for no fog.
        rain_mm_h: Rain rate in mm/h.

    Returns:
        Extinction coefficient in 1/m.
    """
    decibels_per_km = 1.076 * rain_mm_h**0.67
    rain_per_m = decibels_per_km * np.log(10.0) / 10.0 / 1e3
    return float(rain_per_m + (0.0 if visibility_m is None else float(np.log(20.0)) / visibility_m))


class Weather(BuiltInDocument):
    """State of air and road.

    Args:
        name: Name in tables.
        description: Weather and source of the numbers.
        visibility_m: Meteorological optical range in fog (5 % contrast); None for clear air.
        rain_mm_h: Rain rate in mm/h.
        road: A wet road reflects light forwards, see the material `wet_road`.

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
        """Extinction coefficient of the air in 1/m, for one way."""
        return compute_extinction_per_m(self.visibility_m, self.rain_mm_h)


CLEAR = Weather(name="clear")
