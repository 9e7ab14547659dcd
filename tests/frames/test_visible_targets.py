"""Ground truth that a rig could show: what is left out, and that shares stay beside their boxes."""

import math

import pytest
import torch
from torch.utils.data import DataLoader

from torchcover.data import Augmentation, Frame, SimulatedFrames, VisibleBoxes, collate_frames
from torchcover.detection import Boxes, BoxVisibility, measure_box_visibility

PLACES_M = (10.0, 20.0, 30.0, 40.0)


def a_frame(**others):
    """Four boxes: seen by 3 of 4 points, by 1 of 4, hidden, unseen."""
    boxes = Boxes.from_rows(
        torch.tensor([[x, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0] for x in PLACES_M]),
        categories=("car", "van", "car", "car"),
        points_in_box={"rig": torch.tensor([3, 1, 0, 0])},
        sampled_points=torch.tensor([4, 4, 4, 4]),
    )
    of_box = torch.tensor([[0.0, 0.5, 0.0], [0.0, -0.9, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 0.9]])
    middles = torch.tensor([[x, 0.0, 1.0] for x in PLACES_M])
    reference = torch.cat([of_box + middles[at] for at in (0, 1, 3)])
    sensor = torch.cat([of_box[:3] + middles[0], of_box[:1] + middles[1]])
    return Frame({"rig": sensor}, reference, 3, "f", counts={"seen": 1}, boxes=boxes, **others)


@pytest.mark.parametrize(
    ("least", "kept"), [(0.0, PLACES_M[:2] + PLACES_M[3:]), (0.25, PLACES_M[:2]), (0.26, PLACES_M[:1]), (0.8, ())]
)
def test_less_visible_and_unknown_boxes_are_counted(least, kept):
    (frame,) = VisibleBoxes([a_frame()], least, threshold_m=0.1)
    assert frame.boxes.center_m[:, 0].tolist() == list(kept)
    assert frame.boxes.visibility.tolist() == [{10.0: 0.75, 20.0: 0.25, 40.0: 0.0}[x] for x in kept]
    assert frame.counts == {"seen": 1, "targets_omitted": 4 - len(kept)}
    assert len(frame.boxes.points_in_box["rig"]) == len(frame.boxes.categories) == len(kept)


def test_shares_follow_boxes_through_loaders_and_augmentation():
    loader = DataLoader(VisibleBoxes([a_frame()] * 3, 0.2, threshold_m=0.1), batch_size=2, collate_fn=collate_frames)
    frames = [Augmentation(max_yaw_rad=1.0)(frame, 0) for batch in loader for frame in batch.frames]
    assert [frame.boxes.visibility.tolist() for frame in frames] == [[0.75, 0.25]] * 3
    assert frames[0].boxes.select_categories("van").visibility.tolist() == [0.25]


def test_simulated_shares_equal_box_visibility():
    frames = SimulatedFrames("urban", "front_roof_32", num_frames=2, frame_interval_s=15.0, boxes=True)
    for frame, kept in zip(frames, VisibleBoxes(frames, 0.3), strict=True):
        seen = measure_box_visibility(
            frame.sensor, frame.reference, frame.boxes, reference_weights=frame.reference_weights
        )
        expected = [name for name, share in zip(frame.boxes.ids, seen.share.tolist(), strict=True) if share >= 0.3]
        assert list(kept.boxes.ids) == expected
        assert 0 < len(expected) < len(frame.boxes)


def test_levels_are_those_of_nuscenes():
    shares = torch.tensor([math.nan, 0.0, 0.39, 0.4, 0.59, 0.6, 0.79, 0.8, 1.0], dtype=torch.float64)
    none = torch.zeros(len(shares), dtype=torch.int64)
    assert BoxVisibility(shares, shares, none, none, none, 0.4).levels.tolist() == [0, 1, 1, 2, 2, 3, 3, 4, 4]


def test_what_cannot_be_filtered_is_told():
    with pytest.raises(ValueError, match="min_visibility: a share from 0 to 1 is needed; got 20"):
        VisibleBoxes([a_frame()], 20)
    with pytest.raises(ValueError, match="frame 'f' has no boxes: SimulatedFrames"):
        VisibleBoxes([Frame({"rig": torch.zeros(1, 3)}, torch.zeros(1, 3), 0, "f")])[0]
