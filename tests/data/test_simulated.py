"""A simulated frame is a pure function of scenario, rig, seed and index."""

import pickle

import pytest
import torch
from torch.utils.data import DataLoader

from torchcover import Rig
from torchcover.data import SimulatedFrames, collate_frames
from torchcover.simulation import ReferenceSensor

SMALL = ReferenceSensor(rows=48, columns=64)


def frames(seed=3, steps=6, rig="front_grille_128"):
    return SimulatedFrames("courtyard", rig, steps=steps, seed=seed, reference=SMALL)


def same(a, b):
    return torch.equal(a.sensor, b.sensor) and torch.equal(a.reference, b.reference) and a.counts == b.counts


def test_a_frame_does_not_depend_on_the_order_of_access():
    dataset = frames()
    late_first = dataset[5]
    for index in range(6):
        dataset[index]
    assert same(late_first, frames()[5])


def test_a_frame_does_not_depend_on_threads():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = frames()[2]
        torch.set_num_threads(4)
        assert same(one, frames()[2])
    finally:
        torch.set_num_threads(before)


def test_a_frame_does_not_depend_on_workers():
    dataset = frames()
    here = [dataset[index] for index in range(6)]
    loader = DataLoader(dataset, batch_size=4, collate_fn=collate_frames, num_workers=2)
    there = [frame for batch in loader for frame in batch.frames]
    assert all(same(a, b) for a, b in zip(here, there, strict=True))
    assert [frame.index for frame in there] == list(range(6))


def test_a_frame_survives_pickling_of_the_dataset_after_use():
    dataset = frames()
    first = dataset[1]
    assert same(pickle.loads(pickle.dumps(dataset))[1], first)


def test_another_seed_or_index_gives_another_reference_but_the_same_sensor_cloud():
    a, b, c = frames(seed=0)[0], frames(seed=1)[0], frames(seed=0)[1]
    assert torch.equal(a.sensor, b.sensor)
    assert not torch.equal(a.reference, b.reference)
    assert not torch.equal(a.reference, c.reference)


def test_the_reference_does_not_depend_on_the_rig():
    assert torch.equal(frames(rig="front_grille_128")[0].reference, frames(rig="front_roof_128")[0].reference)


def test_the_ego_is_in_neither_cloud_and_its_hits_are_counted():
    frame = frames(rig="front_roof_128")[0]
    for cloud in (frame.sensor, frame.reference):
        x, y, z = cloud.T
        assert not ((x.abs() < 2.0) & (y.abs() < 0.8) & (z > 0.3) & (z < 1.6)).any()
    assert frame.counts["sensor_self_hits"] > 0
    assert frame.counts["sensor_rays"] == 128 * 1800
    assert frame.counts["reference_rays"] == 48 * 64


def test_sensors_are_fused():
    grille, roof = Rig.load("front_grille_128").sensors[0], Rig.load("front_roof_128").sensors[0]
    both = frames(rig=Rig(name="both", sensors=(grille, roof)))[0]
    one, other = frames(rig="front_grille_128")[0], frames(rig="front_roof_128")[0]
    assert torch.equal(both.sensor, torch.cat([one.sensor, other.sensor]))
    assert both.counts["sensor_rays"] == 2 * 128 * 1800


@pytest.mark.parametrize("index", [-1, 6, 100])
def test_an_index_outside_is_an_index_error(index):
    with pytest.raises(IndexError, match=f"frame {index} of 6"):
        frames()[index]


@pytest.mark.parametrize(
    ("changes", "message"), [({"steps": 0}, "steps: at least 1 is needed; got 0"), ({"seed": -1}, "seed: .* got -1")]
)
def test_impossible_requests_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        frames(**changes)
