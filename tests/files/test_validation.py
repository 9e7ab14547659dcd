"""Mistakes in files are explained by what is needed and what arrived."""

from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from torchcover.files import explain_validation_error


class Sphere(BaseModel):
    type: Literal["sphere"]
    radius_m: float = 1.0


class Cube(BaseModel):
    type: Literal["cube"]


class Sensor(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True)

    name: Annotated[str, Field(min_length=2, max_length=4, pattern="^[a-z]*$")] = "roof"
    rows: Annotated[int, Field(ge=1, le=1000)] = 1
    range_m: Annotated[float, Field(gt=0, lt=500.0)] = 1.0
    is_mounted: bool = True
    kind: Literal["lidar", "radar"] = "lidar"
    angles_deg: Annotated[list[float], Field(min_length=2, max_length=3)] = [1.0, 2.0]
    size_m: tuple[float, float] = (1.0, 1.0)
    mount: dict[str, float] = {}
    shape: Annotated[Sphere | Cube, Field(discriminator="type")] = Sphere(type="sphere")


def explain(content: Any, **kwargs: Any) -> str:
    with pytest.raises(ValidationError) as raised:
        Sensor.model_validate(content)
    return "; ".join(explain_validation_error(raised.value, **kwargs))


@pytest.mark.parametrize(
    ("content", "explanation"),
    [
        ("lidar", "a mapping is needed; got 'lidar'"),
        ({"name": 5}, "name: a text is needed; got 5"),
        ({"name": "a"}, "name: a text of at least 2 characters is needed; got 'a'"),
        ({"name": "abcde"}, "name: a text of at most 4 characters is needed; got 'abcde'"),
        ({"name": "ABC"}, "name: a text of the pattern ^[a-z]*$ is needed; got 'ABC'"),
        ({"rows": "1"}, "rows: an integer is needed; got '1'"),
        ({"rows": True}, "rows: an integer is needed; got True"),
        ({"rows": 0}, "rows: a number of at least 1 is needed; got 0"),
        ({"rows": 1001}, "rows: a number of at most 1000 is needed; got 1001"),
        ({"range_m": 0}, "range_m: a number above 0 is needed; got 0"),
        ({"range_m": 500}, "range_m: a number below 500 is needed; got 500"),
        ({"range_m": float("nan")}, "range_m: a finite number is needed; got nan"),
        ({"is_mounted": 1}, "is_mounted: true or false is needed; got 1"),
        ({"kind": "sonar"}, "kind: 'lidar' or 'radar' is needed; got 'sonar'"),
        ({"angles_deg": 3}, "angles_deg: a list is needed; got 3"),
        ({"angles_deg": [1]}, "angles_deg: a list of at least 2 items is needed; got [1]"),
        ({"angles_deg": [1, 2, 3, 4]}, "angles_deg: a list of at most 3 items is needed; got [1, 2, 3, 4]"),
        ({"mount": [1]}, "mount: a mapping is needed; got [1]"),
        ({"shape": {"type": "cone"}}, "shape: one of 'sphere', 'cube' is needed; got {'type': 'cone'}"),
        ({"shape": {"radius_m": 1}}, "shape: a mapping with the key 'type' is needed; got {'radius_m': 1}"),
        ({"shape": {"type": "sphere", "radius_m": "x"}}, "shape.sphere.radius_m: a number is needed; got 'x'"),
        ({"shape": {"type": "sphere", "radius_m": [[[[1]]]]}}, "radius_m: a number is needed; got [[[...]]]"),
        ({"colour": "red"}, "colour: unknown key"),
        ({"rows": "a" * 10**6}, "rows: an integer is needed; got '" + "a" * 27 + "..."),
    ],
)
def test_mistakes_are_explained_without_pydantics_phrases(content, explanation):
    assert explanation in explain(content)


def test_misspelled_keys_are_matched_with_missing_ones():
    class Mount(BaseModel):
        model_config = ConfigDict(extra="forbid")

        height_m: float

    with pytest.raises(ValidationError) as raised:
        Mount.model_validate({"heigth_m": 1.0})
    assert explain_validation_error(raised.value) == ["heigth_m: unknown key; height_m is meant, which is missing"]


def test_unknown_keys_are_suggested_by_the_caller():
    assert explain({"colour": 1}, suggest_key={"colour": "color"}.get) == "colour: unknown key; is color meant?"


def test_further_mistakes_are_counted():
    content = {f"key_{number}": 0 for number in range(7)}
    assert explain(content).endswith("key_4: unknown key; and 2 more mistakes")
