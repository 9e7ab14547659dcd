"""What carries the rigs: a scenario's own ego, or the vehicle that they name."""

from collections.abc import Mapping
from pathlib import Path

from torchcover.simulation.bodies import Shape, VehicleShape, body_called
from torchcover.simulation.rig import Rig
from torchcover.simulation.scenario import DEFAULT_EGO, Mover, Scenario
from torchcover.simulation.shapes import MeshFile


def with_ego(scenario: Scenario, rigs: Mapping[str, Rig], vehicle: str | Path | None = None) -> Scenario:
    """The scenario with the body of what carries the rigs: the first of these that is given.

    `vehicle`; the shape of the scenario's own ego; the vehicle that the rigs name; an SUV.

    Args:
        scenario: The scenario.
        rigs: What is carried; those that name no vehicle go on any.
        vehicle: A built-in vehicle, the YAML file of one, or a mesh file in metres.

    Raises:
        ValueError: The rigs name different vehicles, and nothing else decides; or a vehicle that cannot be used.
        FileNotFoundError: No such vehicle.

    Example:
        >>> with_ego(Scenario.load("courtyard"), {"roof": Rig.load("nuscenes")}).ego_name
        'renault_zoe'
        >>> with_ego(Scenario.load("courtyard"), {"roof": Rig.load("nuscenes")}, "van").ego_name
        'van'
    """
    ego = scenario.ego or Mover()
    shape = ego.shape if vehicle is None else _body("vehicle", body_called(vehicle))
    return scenario.model_copy(update={"ego": ego.model_copy(update={"shape": shape or _of_rigs(rigs)})})


def _of_rigs(rigs: Mapping[str, Rig]) -> Shape:
    named = {name: rig.vehicle for name, rig in rigs.items() if rig.vehicle is not None}
    if len(set(named.values())) > 1:
        told = ", ".join(f"{name} {vehicle}" for name, vehicle in named.items())
        raise ValueError(
            f"the rigs name different vehicles ({told}), but all are compared in the same frames, which have one ego: "
            "say which by --vehicle (in Python, vehicle=)"
        )
    if not named:
        return DEFAULT_EGO
    name, vehicle = next(iter(named.items()))
    return _body(f"rig {name!r}: vehicle", VehicleShape(type="vehicle", vehicle=vehicle))


def _body(owner: str, shape: VehicleShape | MeshFile) -> VehicleShape | MeshFile:
    """The shape, once its file was found."""
    try:
        shape.content()
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{owner}: {error}") from error
    return shape
