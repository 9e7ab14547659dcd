"""Traffic of type `tracks`: the ego and everybody about it as they were recorded."""

import warnings
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from torchcover.geometry import BoundingBox, find_overlaps, invert
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.formats import read_objects
from torchcover.recordings.formats.tracks import read_trajectory
from torchcover.recordings.objects import Ego, RecordedObjects
from torchcover.simulation.bodies import build_checked_mesh
from torchcover.simulation.builtin import hash_builtin_documents
from torchcover.simulation.documents import Pose, RelativePath
from torchcover.simulation.recorded.bodies import (
    BodyLibrary,
    apply_ground_tilt,
    collect_ground_positions,
    find_visible_sides,
    fit_ground,
)
from torchcover.simulation.recorded.excerpt import (
    Excerpt,
    build_pose_matrices,
    choose_ego,
    choose_time_span,
    split_at_gaps,
)
from torchcover.simulation.shapes import Mesh, MeshFile
from torchcover.simulation.traffic.assemble import HORIZON_M
from torchcover.simulation.traffic.fleet import EGO, load_bodies
from torchcover.simulation.traffic.frontage import RoadsideDensity, place_scenery
from torchcover.simulation.traffic.kind import Traffic
from torchcover.simulation.traffic.scenery import merge_by_kind
from torchcover.simulation.world import Actor, Scene, count_time_steps

# A time that is so near to an instant is that instant.
SNAP_S = 1e-6


def _as_id(given: Any) -> Any:  # noqa: ANN401  (whatever stood in the file)
    return str(given) if isinstance(given, int) and not isinstance(given, bool) else given


class RecordedTraffic(Traffic):
    """Traffic as it was recorded; beyond the end of the recording the same plays again.

    Args:
        path: A log of Argoverse 2, tables of nuScenes, a scenario of CommonRoad, a table of boxes, or any recording
            with poses and boxes (KITTI's raw data, CARLA, a plain folder); relative to the document.
        scene: Name or token of one scene of tables of nuScenes that hold several.
        ego_id: Which track is the ego; if not given, the recording's own, or in CommonRoad the start of the first
            planning problem.
        ego_trajectory: File of the ego's own trajectory instead, at times of the same clock.
        ego_T_vehicle: Where the vehicle frame (on the ground under the middle of the body) lies in the frame of the
            recording's own ego, or of its trajectory. If not given, Argoverse 2 and nuScenes have what is published of
            their cars, which begin at the rear axle; all others have none.
        begin_s: When the run begins, from the first time at which the ego and others are known.
        duration_s: Length of the run; all of it if not given.
        max_gap_s: Who was not seen for longer was not there.
        ground: File of a mesh, in metres and in the recording's frame; a height field below the tracks if not given.
        built_share: If it is given, what stands beside streets is drawn beside what was driven, with houses on such a
            share of the sides: none of that was recorded.
        roadside_density: How many times as much of it but houses there is than usually, or of some kinds of it.
        time_step_s: Time between two frames.
    """

    is_repeating: ClassVar[bool] = True

    type: Literal["tracks"] = "tracks"
    path: RelativePath
    scene: str | None = None
    ego_id: Annotated[str | None, BeforeValidator(_as_id)] = None
    ego_trajectory: RelativePath | None = None
    ego_T_vehicle: Pose | None = None
    begin_s: Annotated[float, Field(ge=0.0)] = 0.0
    duration_s: Annotated[float | None, Field(ge=0.0)] = None
    max_gap_s: Annotated[float, Field(gt=0.0)] = 1.0
    ground: RelativePath | None = None
    built_share: Annotated[float | None, Field(ge=0.0, le=1.0)] = None
    roadside_density: RoadsideDensity = 1.0

    @model_validator(mode="after")
    def _check_drawn(self) -> Self:
        if self.built_share is None and self.roadside_density != 1.0:
            raise ValueError("roadside is for what is drawn beside tracks: give built_share, too, from 0 to 1")
        if self.built_share is not None and self.ground is not None:
            raise ValueError(
                "built_share is for tracks without a ground of their own; leave out ground, or built_share"
            )
        return self

    @property
    def sampling_note(self) -> str:
        """What stands beside streets, if it is drawn."""
        if self.built_share is None:
            return ""
        return (
            f"Drawn, not recorded: what stands beside the tracks, with houses on {self.built_share:.0%} of the sides."
        )

    @property
    def num_time_steps(self) -> int:
        """Number of instants."""
        return count_time_steps(self._run.duration_s, self.time_step_s)

    def collect_content(self) -> dict[str, Any]:
        """Its keys, what was recorded, and the bodies that may stand for boxes."""
        return {
            **Traffic.collect_content(self.model_copy(update={"path": None})),
            "objects": self._objects.compute_digest(),
            "vehicles": hash_builtin_documents("vehicles"),
        }

    def build_scene(self, seed: int, ego_mesh: Mesh | None = None) -> Scene:
        """Build the world in the frame of the recording, and draw what stands beside streets if that is asked for.

        Who is where the ego is at an instant is left out, with a warning.
        """
        run = self._run
        drive = self._shown(run.ego_trajectory)
        mesh = load_bodies()["suv"] if ego_mesh is None else ego_mesh
        driver = Actor(EGO, "car", mesh, Trajectory(drive.times_s, drive.positions_m, drive.angles_deg))
        others = list(self._actors(driver.trajectory, BodyLibrary()))
        shown = self._apart(driver, others)
        left_out = len(others) - len(shown)
        stood: tuple[Mesh, ...] = ()
        if self.ground is None:
            standing = [track.trajectory.positions_m for track in run.other_tracks if track.vehicle_class is not None]
            below = fit_ground(
                collect_ground_positions(standing),
                collect_ground_positions([driver.trajectory.interpolate_positions_m(self._times_s)]),
            )
            if self.built_share is not None:
                generator = np.random.default_rng(seed)
                sides, driven, walked = find_visible_sides(driver, shown, self.built_share, generator)
                stood = merge_by_kind(
                    *place_scenery(sides, driven, walked, (), below.compute_heights_m, self.roadside_density, generator)
                )
            ground, driver, shown = (
                below.build_mesh(),
                apply_ground_tilt(driver, below),
                [apply_ground_tilt(other, below) for other in shown],
            )
        else:
            ground = self._read(self.ground)
        return Scene(
            (ground, *stood),
            driver,
            tuple(shown),
            self.time_step_s,
            run.duration_s,
            ground_mesh_indices=(0,),
            num_omitted_road_users=left_out,
        )

    @cached_property
    def _objects(self) -> RecordedObjects:
        return read_objects(self.path, self.scene)

    @cached_property
    def _run(self) -> Excerpt:
        recording = self._objects
        if self.ego_trajectory is not None:
            if self.ego_id is not None:
                raise ValueError("ego_id and ego_trajectory exclude each other: the ego is one of them")
            drive = read_trajectory(self.ego_trajectory)
            driven = Ego(self.ego_trajectory.name, drive.times_s, build_pose_matrices(drive), np.eye(4))
            recording = RecordedObjects(recording.tracks, (driven,))
        frame = None if self.ego_T_vehicle is None else self.ego_T_vehicle.to_matrix()
        try:
            return choose_time_span(
                choose_ego(recording, self.ego_id, frame), self.begin_s, self.duration_s, self.max_gap_s
            )
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from error

    def _shown(self, trajectory: Trajectory) -> Trajectory:
        times_s = trajectory.times_s - self._run.begin_s
        steps = np.round(times_s / self.time_step_s)
        instants_s = self.time_step_s * steps
        times_s = np.where(np.abs(times_s - instants_s) < SNAP_S, instants_s, times_s)
        return Trajectory(times_s, trajectory.positions_m, trajectory.angles_deg, trajectory.is_transient)

    @property
    def _times_s(self) -> Matrix:
        """(T,) the instants."""
        return self.time_step_s * np.arange(self.num_time_steps, dtype=np.float64)

    def _actors(self, drive: Trajectory, bodies: BodyLibrary) -> Iterator[Actor]:
        """Everybody who is there during the run and ever comes within the range of sensors."""
        for track in self._run.other_tracks:
            category, mesh = bodies.get_category_and_mesh(track)
            for number, piece in enumerate(split_at_gaps(track.trajectory, self.max_gap_s), 1):
                shown = self._shown(piece)
                there = not shown.is_transient or (
                    shown.times_s[0] <= self._run.duration_s and shown.times_s[-1] >= 0.0
                )
                away_m = np.linalg.norm(shown.positions_m - drive.interpolate_positions_m(shown.times_s), axis=1)
                if there and away_m.min() < HORIZON_M + max(track.size_m[:2]):
                    yield Actor(track.name if number == 1 else f"{track.name} #{number}", category, mesh, shown)

    def _apart(self, ego: Actor, others: list[Actor]) -> list[Actor]:
        """Those whose bounding boxes meet that of the ego at no instant; a warning names the others."""
        times_s = self._times_s
        ego_m, box = ego.trajectory.interpolate_positions_m(times_s), BoundingBox.from_points(ego.mesh.vertices_m)
        reach_m = float(np.linalg.norm(box.corners_m, axis=1).max())
        met: list[str] = []
        for other in others:
            its_box = BoundingBox.from_points(other.mesh.vertices_m)
            away_m = np.linalg.norm(other.trajectory.interpolate_positions_m(times_s) - ego_m, axis=1)
            near_s = times_s[away_m < reach_m + np.linalg.norm(its_box.corners_m, axis=1).max()]
            there = invert(ego.trajectory.interpolate_many(near_s)) @ other.trajectory.interpolate_many(near_s)
            if find_overlaps(its_box, there, box.corners_m).any():
                met.append(other.name)
        if met:
            warnings.warn(
                f"{self.path}: {len(met)} of {len(others)} tracks are where the ego is at some time "
                f"({', '.join(map(repr, met[:3]))}); they are left out",
                stacklevel=2,
            )
        return [other for other in others if other.name not in met]

    @staticmethod
    def _read(ground: Path) -> Mesh:
        return build_checked_mesh(MeshFile(type="mesh", path=ground), str(ground))
