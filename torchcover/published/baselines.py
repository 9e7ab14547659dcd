"""What any metric has to beat: numbers of a rig that nobody needs a simulation for."""

from torchcover.simulation import Rig


def mean_height_m(rig: Rig) -> float:
    """Mean height of a rig's sensors above the ground, in metres.

    Example:
        >>> mean_height_m(Rig.load("place3d2024_center"))
        2.5
    """
    return round(sum(sensor.mount.z_m for sensor in rig.sensors) / len(rig.sensors), 6)


def rays(rig: Rig) -> int:
    """How many rays a rig casts in a step.

    Example:
        >>> rays(Rig.load("place3d2024_center"))
        16000
    """
    return sum(sensor.rays for sensor in rig.sensors)
