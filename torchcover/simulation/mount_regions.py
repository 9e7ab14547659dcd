"""Mount regions: named patches of a vehicle's skin that sensors can be mounted on."""

from typing import Annotated, Self

from pydantic import AfterValidator, model_validator

from torchcover.simulation.documents import Coordinate, Document
from torchcover.simulation.skin import SEEN_FROM, Side, Skin, SkinPoint

AXES = "xyz"
# Where a level sensor of yaw 0 looks.
FACING_DEG: dict[Side, float] = {"above": 0.0, "front": 0.0, "rear": 180.0, "left": 90.0, "right": -90.0}


def _ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    if not bounds[0] < bounds[1]:
        raise ValueError(f"the lower bound must be below the upper one; got {bounds[0]:g} to {bounds[1]:g} m")
    return bounds


Bounds = Annotated[tuple[Coordinate, Coordinate], AfterValidator(_ascending)]


class MountRegion(Document):
    """A patch of a vehicle's skin that sensors can be mounted on: what is seen of the body in a window, from one side.

    Args:
        seen_from: "above", "front", "rear", "left" or "right".
        x_m: Lower and upper bound forward; not for the front and the rear.
        y_m: Lower and upper bound to the left; not for the left and the right.
        z_m: Lower and upper bound upwards; not for what is seen from above.
        facing_deg: Heading of a sensor of yaw 0. Not given: forward on top, else to where the side faces: 0 at the
            front, 90 on the left, 180 at the rear, -90 on the right.

    Example:
        >>> from torchcover.simulation.shapes import Box
        >>> from torchcover.simulation.skin import Skin
        >>> skin = Skin(Box(type="box", size_m=(4.0, 2.0, 1.5)).mesh())
        >>> left = MountRegion(seen_from="left", x_m=(1.0, 2.0), z_m=(0.5, 1.0))
        >>> point = left.on(skin, u=0.5, v=0.0)
        >>> point.place_m, point.outward
        (array([1.5, 1. , 0.5]), array([0., 1., 0.]))
    """

    seen_from: Side
    x_m: Bounds | None = None
    y_m: Bounds | None = None
    z_m: Bounds | None = None
    facing_deg: float | None = None

    @model_validator(mode="after")
    def _check_window(self) -> Self:
        along = AXES[SEEN_FROM[self.seen_from][0]]
        given = [axis for axis in AXES if getattr(self, f"{axis}_m") is not None]
        needed = [axis for axis in AXES if axis != along]
        if given != needed:
            raise ValueError(
                f"seen from {self.seen_from}, a window has {needed[0]}_m and {needed[1]}_m; "
                f"got {' and '.join(f'{axis}_m' for axis in given) or 'neither'}"
            )
        return self

    @property
    def heading_deg(self) -> float:
        """Heading of a sensor of yaw 0."""
        return FACING_DEG[self.seen_from] if self.facing_deg is None else self.facing_deg

    def on(self, skin: Skin, u: float, v: float) -> SkinPoint:
        """A place on the skin.

        Args:
            skin: Of the vehicle.
            u: From 0 to 1 along the first of the window's axes in the order x, y, z: forward, or to the left.
            v: From 0 to 1 along the second: to the left, or upwards.

        Raises:
            ValueError: Nothing of the body is there.
        """
        window = [bounds for bounds in (self.x_m, self.y_m, self.z_m) if bounds is not None]
        (x, y) = (low + share * (high - low) for share, (low, high) in zip((u, v), window, strict=True))
        point = skin.seen_from(self.seen_from, (x, y))
        if point is None:
            axes = [axis for axis in AXES if getattr(self, f"{axis}_m") is not None]
            raise ValueError(
                f"at {axes[0]} = {x:.3f} m, {axes[1]} = {y:.3f} m (u = {u:g}, v = {v:g}) nothing of the body is seen "
                f"from {self.seen_from}"
            )
        return point
