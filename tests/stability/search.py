"""Nearest neighbors at the limits, for every backend."""

import contextlib
from functools import lru_cache, partial

import numpy as np
import torch

from .case import Case, longdouble_distance, most, ulps

HALF_ULP = 0.5 + 1e-6  # float32: the distance is rounded once, from float64
MAX_ULPS = 4.0  # float64: three squares, two sums, a root
THRESHOLDS_M = [step / 20 for step in range(1, 41)]


def matrix_product(reference, sensor):
    """Compute distances as torch.cdist for more than 25 points."""
    clouds = (torch.as_tensor(cloud) for cloud in (reference, sensor))
    return torch.cdist(*clouds, compute_mode="use_mm_for_euclid_dist").amin(dim=1).numpy()


def differences(reference, sensor):
    """Compute distances naively in the type of the clouds."""
    with np.errstate(over="ignore", under="ignore"):
        return np.sqrt(((reference[:, None] - sensor) ** 2).sum(axis=2)).min(axis=1)


@lru_cache
def street(dtype=np.float32):
    """A rig's cloud over 160 m x 40 m, and reference points a few centimetres beside some of its points."""
    generator = np.random.default_rng(0)
    sensor = generator.uniform([-80.0, -20.0, 0.0], [80.0, 20.0, 3.0], size=(3000, 3))
    reference = sensor[::10] + generator.normal(scale=0.03, size=(300, 3))
    return reference.astype(dtype), sensor.astype(dtype)


def millimetres(cloud):
    """Coordinates that stay exact when ten thousand kilometres are added."""
    return np.round(cloud.astype(np.float64) * 1024) / 1024


@lru_cache
def offset_clouds(offset_m):
    here = [millimetres(cloud) for cloud in street()]
    there = [cloud + np.array([offset_m, -offset_m, 0.0]) for cloud in here]
    return longdouble_distance(*here), there


def offset(offset_m, search):
    expected, clouds = offset_clouds(offset_m)
    return most(search.distance(*clouds) - expected)


def offset_in_float32(offset_m):
    expected, clouds = offset_clouds(offset_m)
    return most(differences(*(cloud.astype(np.float32) for cloud in clouds)) - expected)


def clouds_of(name):
    reference, sensor = street()
    generator = np.random.default_rng(1)
    along = generator.uniform(-80.0, 80.0, size=(2, 3000, 1)).astype(np.float32)
    line = along * np.array([0.8, 0.599, 0.03], dtype=np.float32)
    flat = np.concatenate([along, generator.uniform(-20.0, 20.0, size=(2, 3000, 1)), np.zeros((2, 3000, 1))], axis=2)
    return {
        "street": (reference, sensor),
        "equal": (sensor, sensor),
        "micrometre": (street(np.float64)[1][:300] + 1e-6, street(np.float64)[1]),
        "apart": (reference, sensor + np.float32(1e5)),
        "single": (reference, sensor[:1]),
        "one and one": (reference[:1], sensor[:1]),
        "duplicates": (reference, np.repeat(sensor, 16, axis=0)),
        "collinear": (line[0, :300], line[1]),
        "coplanar": tuple(flat.astype(np.float32)[k][: (300, 3000)[k]] for k in (0, 1)),
        "float16": tuple(torch.from_numpy(cloud).half() for cloud in street()),
        "bfloat16": tuple(torch.from_numpy(cloud).bfloat16() for cloud in street()),
        "1e-41": tuple((cloud.astype(np.float64) * 1e-41).astype(np.float32) for cloud in street()),
        "1e30": tuple(cloud * np.float32(1e30) for cloud in street()),
        "1e-310": tuple(cloud.astype(np.float64) * 1e-310 for cloud in street()),
        "1e300": tuple(cloud.astype(np.float64) * 1e300 for cloud in street()),
    }[name]


@lru_cache
def clouds(name):
    """The two clouds and their distances, found in a type that is wider, or after a power of two is taken out."""
    reference, sensor = clouds_of(name)
    wide = [cloud.float().numpy() if isinstance(cloud, torch.Tensor) else cloud for cloud in (reference, sensor)]
    scale = np.longdouble(2.0) ** np.round(np.log2(np.abs(wide[1]).max().astype(np.longdouble)))
    expected = longdouble_distance(*(cloud.astype(np.longdouble) / scale for cloud in wide)) * scale
    return reference, sensor, expected


def in_ulps(name, search):
    *pair, expected = clouds(name)
    return ulps(search.distance(*pair), expected)


def naive_in_ulps(name, way):
    *pair, expected = clouds(name)
    return ulps(way(*pair), expected)


def in_own_type(reference, sensor):
    """Compute distances in half precision."""
    with np.errstate(over="ignore"):
        return (reference[:, None] - sensor).square().sum(dim=2).sqrt().amin(dim=1).float().numpy()


def equal(search):
    return most(search.distance(*clouds("equal")[:2]))


def equal_by_products():
    return most(matrix_product(*clouds("equal")[:2]))


@lru_cache
def lattice(side):
    """A point at every metre, and reference points (0.3, 0.2, 0.1) m beside some of them."""
    axis = np.arange(side, dtype=np.float32)
    sensor = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    reference = sensor[:: len(sensor) // 64].astype(np.float64) + np.array([0.3, 0.2, 0.1])
    return reference, sensor


def many(side, search):
    reference, sensor = lattice(side)
    return most(search.distance(reference, sensor) - np.sqrt(0.14))


def many_by_products(side):
    reference, sensor = (cloud.astype(np.float32) for cloud in lattice(side))
    result = [matrix_product(reference[k : k + 4], sensor) for k in range(0, len(reference), 4)]
    return most(np.concatenate(result) - np.sqrt(0.14))


@lru_cache
def around(threshold_m):
    """Points within a rounding of a threshold from the origin, and which of them are within it."""
    direction = np.random.default_rng(2).normal(size=(200, 3))
    points = (threshold_m * direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    exactly = np.array([[threshold_m, 0, 0]], dtype=np.float32)
    points = np.concatenate([points, exactly, np.nextafter(exactly, np.float32(9))])
    return points, longdouble_distance(points, np.zeros((1, 3))).astype(np.float32) <= np.float32(threshold_m)


def threshold(search):
    origin, wrong = np.zeros((1, 3), dtype=np.float32), 0
    for limit_m in THRESHOLDS_M:
        points, within = around(limit_m)
        wrong += int((np.isfinite(search.distance(points, origin, max_distance=limit_m)) != within).sum())
    return wrong


def threshold_by_squares():
    judged = [(around(t)[0] ** 2).sum(axis=1) <= np.float32(t) ** 2 for t in THRESHOLDS_M]
    return sum(int((result != around(t)[1]).sum()) for t, result in zip(THRESHOLDS_M, judged, strict=True))


@contextlib.contextmanager
def reduced_precision():
    """Float32 products may be rounded to TF32 or bfloat16, and autocast rounds them to bfloat16."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        with torch.autocast("cpu", dtype=torch.bfloat16), torch.autocast("cuda", enabled=torch.cuda.is_available()):
            yield
    finally:
        torch.set_float32_matmul_precision(before)


@contextlib.contextmanager
def reduced_precision_of_a_backend():
    """The same by the settings of torch 2.9 and newer, after which the older ones may no longer be asked."""
    settings = [getattr(getattr(torch.backends, name), "matmul", None) for name in ("mkldnn", "cuda")]
    settings = [matmul for matmul in settings if hasattr(matmul, "fp32_precision")]
    for matmul, reduced in zip(settings, ("bf16", "tf32"), strict=False):
        matmul.fp32_precision = reduced
    try:
        yield
    finally:
        for matmul in settings:
            matmul.fp32_precision = "none"


def under(context, way, *arguments):
    with context():
        return way(*arguments)


def products_under_autocast():
    reference, sensor, expected = clouds("street")
    q, p = (torch.from_numpy(cloud) for cloud in (reference, sensor))
    squared = q.square().sum(1, keepdim=True) - 2 * (q @ p.T).float() + p.square().sum(1)
    return ulps(squared.clamp(min=0).sqrt().amin(1).float().numpy(), expected)


def shape(what, name, naive_way, way, expected="longdouble, brute force", bound=HALF_ULP):
    return Case(what, expected, "ulp", bound, partial(in_ulps, name), naive_way, partial(naive_in_ulps, name, way))


PRODUCTS, SAME = "cdist by matrix products, float32", "the clouds around the origin"
CASES = [
    Case("1e6 m from the origin, float64", SAME, "m", 1e-15, partial(offset, 1e6),
         "float32 coordinates", partial(offset_in_float32, 1e6)),
    Case("1e7 m from the origin, float64", SAME, "m", 1e-15, partial(offset, 1e7),
         "float32 coordinates", partial(offset_in_float32, 1e7)),
    Case("the two clouds equal", "0", "m", 0.0, equal, PRODUCTS, equal_by_products),
    shape("1e-6 m apart, float64", "micrometre", "cdist by matrix products, float64", matrix_product, bound=MAX_ULPS),
    shape("1e5 m apart", "apart", PRODUCTS, matrix_product),
    shape("a single sensor point", "single", PRODUCTS, matrix_product),
    shape("one point each", "one and one", PRODUCTS, matrix_product),
    shape("every point 16 times", "duplicates", PRODUCTS, matrix_product),
    shape("collinear", "collinear", PRODUCTS, matrix_product),
    shape("coplanar", "coplanar", PRODUCTS, matrix_product),
    Case("5,000,211 sensor points", "closed form", "m", 5e-14, partial(many, 171),
         PRODUCTS, partial(many_by_products, 171), benchmark_only=True),
    Case("132,651 sensor points", "closed form", "m", 5e-14, partial(many, 51), PRODUCTS,
         partial(many_by_products, 51)),
    Case("thresholds equal to a distance", "longdouble, rounded to float32", "of 8,080 wrong", 0.0, threshold,
         "float32 squares", threshold_by_squares),
    shape("coordinates of 1e-40, subnormal", "1e-41", "float32 squares", differences),
    shape("coordinates of 1e32", "1e30", "float32 squares", differences),
    shape("coordinates of 1e-308, subnormal, float64", "1e-310", "float64 squares", differences, bound=MAX_ULPS),
    shape("coordinates of 1e302, float64", "1e300", "float64 squares", differences, bound=MAX_ULPS),
    shape("float16 clouds", "float16", "float16 arithmetic", in_own_type, "longdouble of the same numbers"),
    shape("bfloat16 clouds", "bfloat16", "bfloat16 arithmetic", in_own_type, "longdouble of the same numbers"),
    Case("TF32, bfloat16 products and autocast on", "longdouble, brute force", "ulp", HALF_ULP,
         partial(under, reduced_precision, in_ulps, "street"),
         "matrix products under autocast", partial(under, reduced_precision, products_under_autocast)),
    Case("bfloat16 products by fp32_precision", "longdouble, brute force", "ulp", HALF_ULP,
         partial(under, reduced_precision_of_a_backend, in_ulps, "street"),
         PRODUCTS, partial(under, reduced_precision_of_a_backend, naive_in_ulps, "street", matrix_product)),
]  # fmt: skip
