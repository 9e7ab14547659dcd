"""Accuracy and speed of the lens inverse, beside kornia's and OpenCV's, as Markdown tables.

    python -m benchmarks.camera_accuracy [cameras.json] > tables.md

The file lists calibrations: {"cameras": [{"id", "model", "width", "height", "fx", "fy", "cx", "cy", "params"}]}.
Without it only the synthetic extremes below are measured. Needs kornia and opencv-python-headless.
"""

import argparse
import json
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from kornia.geometry.calibration import undistort_points
from kornia.geometry.camera.distortion_kannala_brandt import undistort_points_kannala_brandt

from torchcover.cameras import Camera

MAX_PIXELS = 1 << 20
ORDER = {
    "brown_conrady": ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"],
    "kannala_brandt": ["k1", "k2", "k3", "k4"],
    "theta_polynomial": ["k1", "k2", "k3", "k4"],
    "mei": ["xi", "k1", "k2", "p1", "p2"],
    "eucm": ["alpha", "beta"],
    "double_sphere": ["xi", "alpha"],
    "pinhole": [],
}
ALIASES = {"rational": "brown_conrady", "poly_theta": "theta_polynomial"}
HD = (1920, 1080, 1000.0, 1000.0, 959.5, 539.5)
# The fold of r (1 - 0.3 r^2) lies at 0.70 focal lengths of image: inside this image, whose corners reach 1.1.
EXTREMES = [
    *[(f"k1 = {k1:+.1f}", (*HD, "brown_conrady", [k1, 0.0, 0.0, 0.0])) for k1 in (-0.6, -0.4, -0.2, 0.2, 0.4, 0.6)],
    ("three focal lengths off", (1920, 1080, 320.0, 320.0, 959.5, 539.5, "brown_conrady", [0.3, 0.05, 1e-3, 1e-3])),
    ("tangential and prism", (*HD, "brown_conrady", [-0.2, 0.05, 3e-3, -2e-3, *[0.0] * 4, 0.01, 2e-3, -0.01, 0.0])),
    ("tilted sensor", (*HD, "brown_conrady", [-0.1, *[0.0] * 11, 0.1, -0.05])),
    ("fold inside the image", (*HD, "brown_conrady", [-0.3, 0.0, 0.0, 0.0])),
    ("crooked fold inside the image", (*HD, "brown_conrady", [-0.3, 0.02, 0.01, -0.02])),
    ("f = 20 px", (640, 480, 20.0, 20.0, 319.5, 239.5, "brown_conrady", [0.05, 0.0, 1e-4, 0.0])),
    ("f = 20,000 px", (1920, 1080, 2e4, 2e4, 959.5, 539.5, "brown_conrady", [-0.4, 1.0, 1e-3, 1e-3])),
    ("axis outside", (1920, 1080, 1500.0, 1500.0, -900.0, 1400.0, "brown_conrady", [-0.05, 4e-3, 1e-4, 1e-4])),
    ("fisheye 190 degrees", (1200, 1200, 360.0, 360.0, 599.5, 599.5, "kannala_brandt", [-0.02, 3e-3, -1e-3, 1e-4])),
    ("fisheye 220 degrees", (1200, 1200, 310.0, 310.0, 599.5, 599.5, "kannala_brandt", [0.01, -2e-3, 0.0, 0.0])),
    ("fisheye with a fold inside", (1200, 1200, 500.0, 500.0, 599.5, 599.5, "kannala_brandt", [-0.15, 0.0, 0.0, 0.0])),
]  # fmt: skip


def load(path):
    for entry in json.loads(Path(path).read_text())["cameras"]:
        model = ALIASES.get(entry["model"], entry["model"])
        coefficients = [entry["params"][name] for name in ORDER[model] if name in entry["params"]]
        numbers = [entry[key] for key in ("width", "height", "fx", "fy", "cx", "cy")]
        yield entry["id"], (*numbers, model, coefficients)


def sample(camera):
    """All pixels, or every second, third, ... row and column of a large image."""
    stride = int(np.ceil(np.sqrt(camera.width * camera.height / MAX_PIXELS)))
    y, x = torch.meshgrid(torch.arange(0, camera.height, stride), torch.arange(0, camera.width, stride), indexing="ij")
    return torch.stack((x, y), dim=-1).reshape(-1, 2).double()


def timed(function, runs=3):
    """Result and least time of some runs."""
    times = []
    for _ in range(runs):
        begin = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - begin)
    return result, min(times)


def describe(camera, rays, pixels, seconds, megapixels):
    error = (camera.project(rays)[0] - pixels).norm(dim=1).nan_to_num(torch.inf).numpy()
    median, most, worst = np.sort(error)[[len(error) // 2, int(0.99 * (len(error) - 1)), -1]]
    cells = [f"{value:.0e}" if value < 1e-3 else f"{value:.3g}" for value in (median, most, worst)]
    return " / ".join(cells) + f" | {1000 * seconds / megapixels:.0f}"


def on_plane(points):
    return torch.nn.functional.pad(points.reshape(-1, 2), (0, 1), value=1.0)


def kornias(camera, pixels):
    fx, fy, cx, cy = camera.intrinsics.tolist()
    if camera.model == "kannala_brandt":
        parameters = torch.cat((camera.intrinsics, camera.coefficients))
        return lambda: on_plane(undistort_points_kannala_brandt(pixels, parameters))
    matrix = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)
    identity = torch.eye(3, dtype=torch.float64)
    return lambda: on_plane(undistort_points(pixels, matrix, camera.coefficients, identity))


def opencvs(camera, pixels):
    fx, fy, cx, cy = camera.intrinsics.tolist()
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    inverse = cv2.fisheye.undistortPoints if camera.model == "kannala_brandt" else cv2.undistortPoints
    points, coefficients = pixels.numpy()[:, None], camera.coefficients.numpy()
    return lambda: on_plane(torch.from_numpy(inverse(points, matrix, coefficients)))


def row(name, numbers):
    camera = Camera(*numbers, name=name)
    pixels = sample(camera)
    megapixels = len(pixels) / 1e6
    # A new camera for every run: finding the valid region is part of the price.
    (rays, valid), seconds = timed(lambda: Camera(*numbers).rays(pixels))
    ours = describe(camera, rays[valid], pixels[valid], seconds, megapixels)
    others = "- | - | - | -"
    if camera.model in ("brown_conrady", "kannala_brandt"):
        parts = []
        for method in (kornias, opencvs):
            points, seconds = timed(method(camera, pixels))
            parts.append(describe(camera, points[valid], pixels[valid], seconds, megapixels))
        others = " | ".join(parts)
    share = 100.0 * valid.double().mean()
    return f"| {name} | {camera.model} | {share:.2f} | {ours} | {others} |"


def speed():
    """Table, unprojection, and kornia's undistortion on every call, on one 1920 x 1080 camera."""
    numbers = (1920, 1080, 930.0, 930.0, 991.0, 541.0, "brown_conrady", [-0.158, -0.027, -1.5e-4, 5.9e-4, 0.045])
    camera, depth = Camera(*numbers), 1.0 + 50.0 * torch.rand(1080, 1920)
    sky = depth.masked_fill(torch.rand(1080, 1920) < 0.2, torch.inf)
    _, table = timed(lambda: Camera(*numbers).rays(), 10)
    pixels = torch.cartesian_prod(torch.arange(1080.0), torch.arange(1920.0)).flip(1)
    matrix = torch.tensor([[930.0, 0.0, 991.0], [0.0, 930.0, 541.0], [0.0, 0.0, 1.0]])
    coefficients, identity = camera.coefficients.float(), torch.eye(3)

    def kornias_cloud():
        return on_plane(undistort_points(pixels, matrix, coefficients, identity)) * depth.reshape(-1, 1)

    clouds = (kornias_cloud, lambda: camera.unproject(depth), lambda: camera.unproject(sky))
    kornia, full, masked = (
        min(times) for times in zip(*[[timed(f, 1)[1] for f in clouds] for _ in range(10)], strict=True)
    )
    megapixels = depth.numel() / 1e6
    print("\n| 1920 x 1080, float32 | seconds | Mpx/s |\n|---|---|---|")
    for name, seconds in (
        ("lens table, once per camera", table),
        ("unprojection with the table, every pixel a point", full),
        ("unprojection with the table, a fifth of the pixels sky", masked),
        ("kornia: undistort on every call, then scale by depth", kornia),
    ):
        print(f"| {name} | {seconds:.4f} | {megapixels / seconds:.0f} |")
    print(f"\nkornia / unprojection: {kornia / full:.0f}; with sky: {kornia / masked:.0f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("calibrations", nargs="?", help="JSON file with real calibrations")
    path = parser.parse_args().calibrations
    print("| camera | model | valid % | ours: px | ms/Mpx | kornia: px | ms/Mpx | OpenCV: px | ms/Mpx |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name, numbers in [*EXTREMES, *(load(path) if path else [])]:
        print(row(name, numbers), flush=True)
    speed()


if __name__ == "__main__":
    main()
