"""Whether a hit gives a return: the range equation with the two numbers of a data sheet, and a material.

A target wider than the beam sends back power in proportion to q = (rho / 0.1) cos(incidence)^k exp(-2 alpha R)
(R10 / R)^2, scaled so that q = 1 is just enough at the range R10 that data sheets give for a reflectivity rho of 10 %.
What is enough differs from pulse to pulse: P(return) = p0 Phi(ln q / (2 s)), where s spreads the range.
"""

import numpy as np
import torch
from numpy.typing import NDArray

Floats = NDArray[np.floating]

# Of the strongest returns as many come back: 98 to 99 % of near road in sweeps of VLP-32C, HDL-32E and HDL-64E.
SURE = 0.985
# Contrast of 5 % (Koschmieder 1924, and the meteorological optical range since): visibility = ln(20) / alpha.
LN_20 = float(np.log(20.0))
# No face is met at a smaller cosine: float32 leaves open what it would be.
LEAST_COSINE = 1e-4


def log_excess(
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


def return_probability(
    log_excess: float | Floats, spread: float | Floats, reflectivity_spread: float | Floats = 0.0
) -> Floats:
    """(N,) P(return) of hits with (N,) ln q, `spread` the standard deviation of ln range of the sensor.

    `reflectivity_spread` (N,) is that of ln reflectivity between places of the material.
    """
    sigmas = np.asarray(log_excess / np.hypot(2.0 * np.asarray(spread), reflectivity_spread))
    return np.asarray(SURE * torch.special.ndtr(torch.from_numpy(sigmas)).numpy())


def extinction_per_m(visibility_m: float | None, rain_mm_h: float = 0.0) -> float:
    """Extinction of light of 905 nm in air, one way: of fog by Koschmieder's law, if there is any, and of rain.

    Rain: 1.076 R^0.67 dB/km, R in mm/h (Carbonneau & Wisely 1998, Proc. SPIE 3232).
    """
    decibels_per_km = 1.076 * rain_mm_h**0.67
    of_rain = decibels_per_km * np.log(10.0) / 10.0 / 1e3
    return float(of_rain + (0.0 if visibility_m is None else LN_20 / visibility_m))
