"""Files read by their types: what is converted, and mistakes in one formula, against lines written by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import jsonschema
import pytest
from pydantic import Field
from typing_extensions import TypedDict

from ballmodel.io import yaml
from ballmodel.io.ranges import Within, check_fields
from ballmodel.io.validation import Increasing, Name, Section, json_schema, validate

Ends = Annotated[tuple[Annotated[float, Within(0.0, 1.0, "s")], Annotated[float, Within(0.0, 1.0, "s")]], Increasing]
Delays = TypedDict("Delays", {"arm.delay": Ends}, total=False)


@dataclass(frozen=True)
class Camera:
    place: tuple[float, float] = (0.0, 0.0)
    rate: Annotated[int, Within(1, 1000, "Hz")] = 125
    mode: Literal["fast", "sharp"] = "fast"


class Square(Section):
    kind: Literal["square"]
    side: float


class Circle(Section):
    kind: Literal["circle"]
    radius: Annotated[float, Field(gt=0)]


class File(Section):
    camera: Camera = Camera()
    shapes: dict[Name, Annotated[Square | Circle, Field(discriminator="kind")]] = {}
    delays: Delays = {}


def test_content_becomes_the_type_and_nothing_is_converted_silently():
    data = {"camera": {"place": [1, 2.5]}, "shapes": {"a": {"kind": "square", "side": 2}}}
    read = validate(File, data | {"delays": {"arm.delay": [0, 0.5]}}, "a.yaml")
    assert read == File(
        camera=Camera((1.0, 2.5)), shapes={"a": Square(kind="square", side=2.0)}, delays={"arm.delay": (0.0, 0.5)}
    )
    jsonschema.validate(data, json_schema(File))


@pytest.mark.parametrize(
    "data, lines",
    [
        (
            {"camera": {"rate": 0, "mode": "shrp", "place": [1]}},
            [
                "camera.place[1]: expected a finite number, got nothing; it has no default",
                "camera.rate: expected a whole number from 1 to 1000 Hz, got 0",
                "camera.mode: expected 'fast' or 'sharp', got 'shrp'; did you mean 'sharp'?",
            ],
        ),
        (
            {"shapes": {"a": {"kind": "circle", "radius": "2"}, "b": {"kind": "squar"}, "c": {}}},
            [
                "shapes.a.radius: expected a number of more than 0, got '2'",
                "shapes.b.kind: expected 'square' or 'circle', got 'squar'; did you mean 'square'?",
                "shapes.c.kind: expected 'square' or 'circle', got nothing; it says which kind of mapping this is",
            ],
        ),
        (
            {"delays": {"arm.delay": [0.5, 0.25], "arm.dely": [0, 1]}, "camera": [True, math.nan]},
            [
                "camera: expected a mapping with the keys place, rate, mode, got [True, nan]",
                "delays.arm.delay: expected numbers in ascending order, got [0.5, 0.25]",
                "delays.arm.dely: expected one of the keys arm.delay, got the unknown key 'arm.dely'; "
                "did you mean 'arm.delay'?",
            ],
        ),
        ([1], ["expected a mapping with the keys camera, shapes, delays, got [1]"]),
    ],
)
def test_every_mistake_is_named_with_key_expected_given_and_remedy(data, lines):
    with pytest.raises(ValueError) as error:
        validate(File, data, "a.yaml")
    assert str(error.value).splitlines() == [f"a.yaml: {line}" for line in lines]


def test_a_built_object_meets_the_ranges_of_its_annotations():
    check_fields(Camera())
    for wrong, message in (
        (Camera(rate=1001), "rate: expected 1 to 1000 Hz, got 1001"),
        (Camera(rate=True), "rate: expected 1 to 1000 Hz, got True"),
        (Camera(mode="slow"), "mode: expected 'fast' or 'sharp', got 'slow'"),
    ):
        with pytest.raises(ValueError, match=message):
            check_fields(wrong)


def test_a_mapping_takes_another_ones_keys_and_changes_some():
    text = "a: &first {x: 1, y: 2}\nb: {<<: *first, y: 3}\n"
    assert yaml.parse(text, "file") == {"a": {"x": 1, "y": 2}, "b": {"x": 1, "y": 3}}
    with pytest.raises(ValueError, match="'y' is given twice"):
        yaml.parse("a: &first {x: 1}\nb: {<<: *first, y: 3, y: 4}\n", "file")
