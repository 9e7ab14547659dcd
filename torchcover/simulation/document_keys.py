"""Keys of documents: suggestions for unknown keys, and recognition of other kinds of documents."""

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

# Keys of other formats -> keys of this package.
FOREIGN_KEYS = {
    **dict.fromkeys(("xyz", "position", "translation", "location"), "x_m, y_m, z_m"),
    **dict.fromkeys(("rpy", "euler"), "roll_deg, pitch_deg, yaw_deg"),
    **dict.fromkeys(("rotation", "orientation", "quaternion"), "quaternion_wxyz, or roll_deg, pitch_deg, yaw_deg,"),
    **dict.fromkeys(("rows", "beams", "lines", "layers"), "channels"),
    **dict.fromkeys(("lidars", "cameras", "radars"), "sensors"),
    "fov": "horizontal_fov_deg, vertical_fov_deg or, of a camera, fov_deg",
    "resolution": "width, height",
    "range": "max_range_m",
}
SETTINGS_KIND = "a file of settings"
# Kind of document -> its required and its optional top-level keys, for files that commands read.
KINDS = {
    SETTINGS_KIND: (
        "",
        "scenario num_frames seed vehicle sensor_model weather regions test_targets cell_m thresholds_m aggregations "
        "reference num_rays average band_frame frame_interval_s target_error only_detection redundancy metrics device "
        "num_workers no_cache skip_bad_frames rerun recording",
    ),
    "a rig": ("sensors", "vehicle weather bodies"),
    "a vehicle": ("parts", "extends mount_regions"),
    "a scenario": ("", "ego bodies actors boxes time_step_s duration_s weather traffic"),
    "a search space": (
        "scenario objectives",
        "vehicle not_worse requirements start free constraints prices_eur fixed_rig candidates baseline",
    ),
    "a set of requirements": ("requirements", "regions heights grid scenario position_sets"),
    "a set of encounters": ("encounters", "num_samples seed"),
    "a file of regions": ("", "regions heights grid"),
}


def suggest_key(key: str, known_keys: Sequence[str]) -> str:
    """Suggest a key for an unknown one: a translation, the key with another unit, or a similar key; empty if none.

    Args:
        key: Unknown key.
        known_keys: Keys of all documents, sorted.

    Example:
        >>> suggest_key("fov", []), suggest_key("yaw_rad", ["yaw_deg"]), suggest_key("chanels", ["channels"])
        ('horizontal_fov_deg, vertical_fov_deg or, of a camera, fov_deg', 'yaw_deg', 'channels')
    """
    if key in FOREIGN_KEYS:
        return FOREIGN_KEYS[key]
    known_keys = [name for name in known_keys if name != key]  # a key of another document is unknown here as well
    units = ("rad", "deg", "mm", "cm", "m", "km", "ft", "in", "s", "ms", "hz", "mps", "kmh")
    stem, _, suffix = key.rpartition("_")
    quantity = stem if suffix in units else key
    same_quantity = [name for name in known_keys if name.rpartition("_")[0] == quantity]
    return next(iter(same_quantity or get_close_matches(key, known_keys, n=1, cutoff=0.8)), "")


def find_other_kind(kind: str, content: Mapping[str, Any]) -> str:
    """Find the kind of document that a file is, if it fits another kind better than the one that is needed.

    Args:
        kind: Kind that is needed, a key of `KINDS`.
        content: Keys of the file.

    Returns:
        A key of `KINDS`; empty if no other kind has more of the keys.

    Example:
        >>> find_other_kind("a vehicle", {"name": "roof", "sensors": []}), find_other_kind("a rig", {"sensor": []})
        ('a rig', '')
    """
    keys = set(content) - {"name", "description"}
    num_mistakes: dict[str, int] = {}
    known_keys: dict[str, set[str]] = {}
    for candidate, (required, optional) in KINDS.items():
        known_keys[candidate] = {*required.split(), *optional.split()}
        num_mistakes[candidate] = len(keys - known_keys[candidate]) + len(set(required.split()) - keys)
    best = min(num_mistakes, key=num_mistakes.__getitem__)
    if kind not in KINDS or num_mistakes[best] >= num_mistakes[kind]:
        return ""
    has_distinctive_keys = bool(keys & (known_keys[best] - known_keys[kind]))
    return best if has_distinctive_keys or (keys and not num_mistakes[best]) else ""
