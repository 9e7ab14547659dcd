"""Quantities of coverage: radii, detection rates, and numbers of a rig without a sensor."""

from torchcover.estimation import Quantity

# Points measured farther off than this do not count where no threshold applies; the threshold of the paper.
MEASURED_WITHIN_M = 0.4


def make_radius_quantity(statistic: str = "", title: str = "mean") -> Quantity:
    """Make a quantity for a statistic of the blind spot radius, in meters.

    Args:
        statistic: Statistic as part of the key; empty for the mean.
        title: Statistic in words.

    Example:
        >>> make_radius_quantity("maximum", "largest")
        Quantity(key='radius_maximum_m', title='largest blind spot radius', unit='m', lower_is_better=True)
    """
    key = f"radius_{statistic}_m" if statistic else "radius_m"
    return Quantity(key, f"{title} blind spot radius", "m", lower_is_better=True)


def make_detection_quantity(threshold_m: float) -> Quantity:
    """Make a quantity for the share of reference points, or frames, whose radius is at most a threshold.

    Args:
        threshold_m: Threshold in meters.
    """
    title = f"detection within {threshold_m:g} m"
    return Quantity(f"detection_{threshold_m:g}m", title, "share", lower_is_better=False)


def make_sensor_count_quantity(threshold_m: float) -> Quantity:
    """Make a quantity for the number of sensors of a rig whose radius is at most a threshold.

    Args:
        threshold_m: Threshold in meters.
    """
    title = f"sensors that detect within {threshold_m:g} m"
    return Quantity(f"sensors_{threshold_m:g}m", title, "sensors", lower_is_better=False)


def make_redundancy_quantity(threshold_m: float) -> Quantity:
    """Make a quantity for the share of reference points that two or more sensors detect within a threshold.

    Args:
        threshold_m: Threshold in meters.
    """
    title = f"detected by two sensors or more within {threshold_m:g} m"
    return Quantity(f"detected_by_two_{threshold_m:g}m", title, "share", lower_is_better=False)


def make_failure_quantity(sensor_name: str, quantity: Quantity) -> Quantity:
    """Make a quantity for a number of the rig without one of its sensors.

    Args:
        sensor_name: Name of the sensor that fails.
        quantity: Number of the whole rig.

    Example:
        >>> make_failure_quantity("roof", make_detection_quantity(0.4)).key
        'detection_0.4m_without_roof'
    """
    title = f"{quantity.title}, without {sensor_name}"
    return quantity._replace(key=f"{quantity.key}_without_{sensor_name}", title=title)


def make_area_quantity(quantity: Quantity) -> Quantity:
    """Make a quantity for the mean over the visible surface.

    Args:
        quantity: Radius or detection rate as mean of means.

    Example:
        >>> make_area_quantity(make_detection_quantity(0.4)).key, make_area_quantity(RADIUS).title
        ('detection_area_0.4m', 'mean blind spot radius, by area')
    """
    kind, unit = quantity.key.split("_", 1)
    return quantity._replace(key=f"{kind}_area_{unit}", title=f"{quantity.title}, by area")


def make_cells_quantity(quantity: Quantity) -> Quantity:
    """Make a quantity for the mean over observed cells, for results whose numbers are by area.

    Args:
        quantity: Radius or detection rate.

    Example:
        >>> make_cells_quantity(RADIUS).key
        'cells_radius_m'
    """
    return quantity._replace(key=f"cells_{quantity.key}", title=f"{quantity.title}, over observed cells")


RADIUS = make_radius_quantity()
