"""What a user knows to be wrong about a recording: nothing is put right unless it is asked for."""

from dataclasses import dataclass
from typing import Annotated, Literal

# The two nearest poses say how a vehicle goes on before the first and after the last.
LONGEST_LAG_S = 1.0


@dataclass(frozen=True)
class Corrections:
    """How a recording is to be read other than its format says.

    Raises:
        ValueError: A lag of more than a second.
    """

    quaternions: Annotated[Literal["wxyz", "xyzw"], "Order of the numbers of a recording's rotations."] = "wxyz"
    poses: Annotated[
        Literal["given", "inverse", "yx", "held"],
        "What poses are: vehicle_T_world (`inverse`), with x and y exchanged (`yx`), or each repeated until the next "
        "(`held`: they are interpolated).",
    ] = "given"
    axes: Annotated[Literal["xyz", "yxz"], "What the columns of its clouds are."] = "xyz"
    units: Annotated[Literal["m", "cm", "mm", "ft"], "What its clouds are in."] = "m"
    lag_s: Annotated[float, "Seconds by which its poses are late."] = 0.0

    def __post_init__(self) -> None:
        if not abs(self.lag_s) <= LONGEST_LAG_S:
            raise ValueError(f"lag: at most {LONGEST_LAG_S:g} s are undone; got {self.lag_s:g}; mend the times instead")

    @property
    def words(self) -> str:
        """As options of the command line; empty without any.

        Example:
            >>> Corrections(units="mm", lag_s=0.1).words
            '--units mm --lag 0.1'
        """
        asked = {name: value for name, value in vars(self).items() if value != getattr(Corrections, name)}
        return " ".join(f"--{name.removesuffix('_s')} {value}" for name, value in asked.items())
