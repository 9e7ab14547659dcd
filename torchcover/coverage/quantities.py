"""The numbers of coverage: radii and detections, and what a rig is without a sensor."""

from torchcover.estimation import Quantity

# What was measured farther off than this is no point where no threshold decides: the threshold of the paper.
MEASURED_WITHIN_M = 0.4


def make_radius_quantity(statistic: str = "", title: str = "mean") -> Quantity:
    """A blind spot radius in metres: which one, as a part of its key, and in words.

    Example:
        >>> make_radius_quantity("maximum", "largest")
        Quantity(key='radius_maximum_m', title='largest blind spot radius', unit='m', lower_is_better=True)
    """
    key = f"radius_{statistic}_m" if statistic else "radius_m"
    return Quantity(key, f"{title} blind spot radius", "m", lower_is_better=True)


def make_detection_quantity(threshold_m: float) -> Quantity:
    """The share of reference points, or steps, whose radius is at most a threshold in metres."""
    return Quantity(
        f"detection_{threshold_m:g}m", f"detection within {threshold_m:g} m", "share", lower_is_better=False
    )


def make_sensor_count_quantity(threshold_m: float) -> Quantity:
    """The number of sensors of a rig whose radius is at most a threshold in metres."""
    title = f"sensors that see within {threshold_m:g} m"
    return Quantity(f"sensors_{threshold_m:g}m", title, "sensors", lower_is_better=False)


def make_redundancy_quantity(threshold_m: float) -> Quantity:
    """The share of reference points that two sensors or more see within a threshold in metres."""
    title = f"detected by two sensors or more within {threshold_m:g} m"
    return Quantity(f"detected_by_two_{threshold_m:g}m", title, "share", lower_is_better=False)


def make_failure_quantity(sensor_name: str, quantity: Quantity) -> Quantity:
    """A number of the rig without one of its sensors.

    Example:
        >>> make_failure_quantity("roof", make_detection_quantity(0.4)).key
        'detection_0.4m_without_roof'
    """
    return quantity._replace(
        key=f"{quantity.key}_without_{sensor_name}", title=f"{quantity.title}, without {sensor_name}"
    )


def make_area_quantity(quantity: Quantity) -> Quantity:
    """The same over the surface that the reference sees, where every square metre weighs the same.

    Example:
        >>> make_area_quantity(make_detection_quantity(0.4)).key, make_area_quantity(RADIUS).title
        ('detection_area_0.4m', 'mean blind spot radius, by area')
    """
    kind, unit = quantity.key.split("_", 1)
    return quantity._replace(key=f"{kind}_area_{unit}", title=f"{quantity.title}, by area")


def make_cells_quantity(quantity: Quantity) -> Quantity:
    """The same over the known cells of a region, every cell weighing the same, where the number itself is by area.

    Example:
        >>> make_cells_quantity(RADIUS).key
        'cells_radius_m'
    """
    return quantity._replace(key=f"cells_{quantity.key}", title=f"{quantity.title}, over known cells")


RADIUS = make_radius_quantity()
