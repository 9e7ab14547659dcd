"""Results of papers are read as printed, and what is not such a table is refused."""

import numpy as np
import pytest

from torchcover.files import BadFileError
from torchcover.published import Judged, read_results
from torchcover.published.ranks import spearman
from torchcover.simulation import Rig, builtin_folder

HEADER = "placement,quantity,model,class,value\n"
PLACE3D = read_results(builtin_folder("published") / "place3d_2024.csv")


def test_the_tables_of_place3d_are_there_with_the_means_and_ceilings_that_follow_from_them():
    cars = PLACE3D["map", "car"]
    assert dict(zip(cars.placements, cars.mean.round(3).tolist(), strict=True)) == {
        "center": 52.525, "line": 49.65, "pyramid": 52.175, "square": 49.95, "trapezoid": 50.925,
        "line_roll": 51.025, "pyramid_roll": 52.125, "optimised_detection": 53.375,
    }  # fmt: skip
    ceilings = {category: PLACE3D["map", category].ceiling for category in ("car", "bicycle", "pedestrian")}
    assert ceilings == {
        "car": pytest.approx(0.85, abs=0.01),
        "bicycle": pytest.approx(0.20, abs=0.01),
        "pedestrian": pytest.approx(-0.10, abs=0.01),
    }
    assert PLACE3D["miou", ""].judges == ("MinkUNet", "PolarNet", "SPVCNN", "Cylinder3D")
    # The paper's own metric ranks cars as its detectors do.
    assert spearman(PLACE3D["m_sog_1e-6", "detection"].of(cars.placements).mean, cars.mean) == pytest.approx(1.0)


def test_every_placement_of_the_table_is_a_rig():
    for judged in PLACE3D.values():
        for placement in judged.placements:
            assert Rig.load(f"place3d2024_{placement}").name == f"place3d2024_{placement}"


@pytest.mark.parametrize(
    ("values", "ceiling"),
    [
        ([[1, 2, 3, 4]], np.nan),
        ([[1, 2, 3, 4], [10, 20, 30, 40]], 1.0),
        ([[1, 2, 3, 4], [4, 3, 2, 1]], -1.0),
        # Of three, two alike and one opposite: (1 - 1 - 1) / 3.
        ([[1, 2, 3, 4], [1, 2, 3, 4], [4, 3, 2, 1]], -1 / 3),
    ],
)
def test_the_ceiling_is_what_judges_agree_on(values, ceiling):
    judges = tuple(f"net {number}" for number in range(len(values)))
    judged = Judged("AP", tuple("abcd"), judges, np.array(values, dtype=float))
    assert judged.ceiling == pytest.approx(ceiling, nan_ok=True)


def test_placements_can_be_chosen_but_not_made_up():
    judged = Judged("AP", tuple("abc"), ("net",), np.array([[1.0, 2.0, 3.0]]))
    assert judged.of(["c", "a"]).values.tolist() == [[3.0, 1.0]]
    with pytest.raises(ValueError, match="nothing is known of d"):
        judged.of(["a", "d"])
    with pytest.raises(ValueError, match="a finite number"):
        Judged("AP", tuple("abc"), ("net",), np.array([[1.0, np.nan, 3.0]]))


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("a,map,net,car,1\na,map,net,car,2\n", "twice"),
        ("a,map,net,car,1\nb,map,net,car,2\na,map,other,car,2\n", "no value of other on b"),
        ("a,map,net,car,high\n", "a finite number is needed; got 'high'"),
    ],
)
def test_a_table_that_is_not_whole_is_refused_by_name(tmp_path, rows, words):
    path = tmp_path / "results.csv"
    path.write_text(HEADER + rows)
    with pytest.raises(BadFileError, match=words) as told:
        read_results(path)
    assert str(path) in str(told.value)
