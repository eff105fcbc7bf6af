"""Operators keep what they declare, whoever wrote them; pipelines are data and refuse nonsense before the work."""

from __future__ import annotations

import inspect
import json

import numpy as np
import pytest
from operator_samples import REFERENCES, SAMPLES

from devices.cli import run
from devices.errors import InputError
from processing.operators import Layer, Operator, find_operator, operators
from processing.pipeline import Pipeline, Step
from processing.table import Picture, Table
from processing.tiles import cut, tiles

NAMES = [o.name for o in operators()]


def copied(layers: dict[str, object]) -> dict[str, object]:
    return {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in layers.items()}


def same(a: object, b: object) -> None:
    a, b = (v.pixels if isinstance(v, Picture) else v.rows if isinstance(v, Table) else v for v in (a, b))
    np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def test_every_operator_has_a_sample():
    assert sorted(SAMPLES) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_pure_the_input_is_unchanged_and_twice_gives_the_same(name: str):
    layers, params = SAMPLES[name]()
    before = copied(layers)
    first, second = (find_operator(name)(layers, **params) for _ in range(2))
    for key, value in layers.items():
        same(value, before[key])
    for key, value in first.items():
        same(value, second[key])
        assert not any(
            np.shares_memory(value, given)
            for given in layers.values()
            if isinstance(given, np.ndarray) and isinstance(value, np.ndarray)
        )


@pytest.mark.parametrize("name", NAMES)
def test_shape_and_type_are_as_declared(name: str):
    layers, params = SAMPLES[name]()
    operator = find_operator(name)
    results = operator(layers, **params)
    for layer in operator.gives:
        value = results[layer.name]
        if layer.shape:
            assert value.shape == layers[layer.shape].shape[-value.ndim :]
        if layer.dtype:
            expected = layers[layer.dtype].dtype if layer.dtype in operator.takes else np.dtype(layer.dtype)
            assert value.dtype == expected


@pytest.mark.parametrize("name", sorted(REFERENCES))
def test_equals_a_slow_reference(name: str):
    layers, params = SAMPLES[name]()
    made = find_operator(name)(layers, **params)
    for key, expected in REFERENCES[name](layers, params).items():
        np.testing.assert_allclose(made[key], expected, rtol=1e-4, atol=1e-4)


def halo_of(name: str) -> tuple[int, ...] | None:
    return Step(name, SAMPLES[name]()[1]).halo


@pytest.mark.parametrize("name", [name for name in NAMES if halo_of(name) is not None])
def test_tiles_agree_with_the_whole(name: str):
    layers, params = SAMPLES[name]()
    operator = find_operator(name)
    halo = halo_of(name)
    assert halo is not None
    shape = layers[operator.gives[0].shape].shape[-len(halo) :]
    whole = operator(layers, **params)
    parts = {layer.name: np.empty_like(whole[layer.name]) for layer in operator.gives}
    for tile in tiles(shape, [max(1, n // 3) for n in shape], halo):
        for key, value in operator(cut(layers, tile.read, shape), **params).items():
            parts[key][tile.write] = value[tile.inner]
    for key, value in parts.items():
        np.testing.assert_allclose(value, whole[key], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_documented_with_what_a_user_needs(name: str):
    operator = find_operator(name)
    words = inspect.getdoc(operator.function)
    assert operator.summary.endswith(".")
    assert words is not None
    assert "Parameters\n" in words
    assert "Returns\n" in words


def test_a_function_stays_what_it_is():
    from processing.range_operators import median

    assert inspect.isfunction(median)


def test_parameters_are_converted_checked_and_filled_in():
    median = find_operator("range.median")
    assert median.settings({"side_px": "7"}) == {"side_px": 7}
    with pytest.raises(InputError, match="did you mean 'side_px'"):
        median.settings({"side": 3})
    with pytest.raises(InputError, match="side_px cannot be 'wide'"):
        median.settings({"side_px": "wide"})
    with pytest.raises(InputError, match=r"needs radius_px"):
        find_operator("range.rolling_ball").settings({})


def test_an_unknown_operator_is_told_with_a_guess():
    with pytest.raises(InputError, match=r"did you mean 'range.median'"):
        find_operator("range.medain")


def test_a_pipeline_is_data_and_comes_back_whole():
    tables = [{"operator": "range.median", "side_px": 3}, {"operator": "range.level"}]
    pipeline = Pipeline.from_tables(tables)
    assert pipeline == Pipeline.from_tables(json.loads(json.dumps(tables)))
    assert pipeline.tables() == [
        {"operator": "range.median", "side_px": 3},
        {"operator": "range.level", "least": 0.8},
    ]
    assert Step.parse("range.median:side_px=3") == Step("range.median", {"side_px": "3"})


def test_a_pipeline_equals_its_steps_by_hand_and_tells_progress():
    layers, _ = SAMPLES["range.level"]()
    told: list[int] = []
    found = Pipeline((Step("range.median"), Step("range.level")))(layers, told.append)
    by_hand = find_operator("range.level")({**layers, **find_operator("range.median")(layers)})
    same(found["range"], by_hand["range"])
    same(found["confidence"], layers["confidence"])
    assert told == [1, 2]


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        (["range.nothing", "range.median"], "no operator is called"),
        (["range.median:side_px=x"], "cannot be"),
        (["range.median:side_px"], "is no step"),
        (["range.median", "range.level"], "step 1, range.median, needs range"),
    ],
)
def test_a_wrong_pipeline_is_refused_before_anything_is_computed(steps: list[str], words: str):
    with pytest.raises(InputError, match=words):
        Pipeline(tuple(Step.parse(s) for s in steps)).check({"volume"})
    with pytest.raises(InputError, match="without the name of its operator"):
        Pipeline.from_tables([{"side_px": 3}])


def test_the_list_names_every_operator(capsys: pytest.CaptureFixture[str]):
    assert run(["process", "operators", "--json"]) == 0
    assert [o["name"] for o in json.loads(capsys.readouterr().out)] == NAMES
    assert run(["process", "operators", "range"]) == 0
    assert "side_px: int = 5" in capsys.readouterr().out
    assert run(["process", "operators", "nothing"]) == 2


def test_tiles_cover_everything_once():
    count = np.zeros((7, 10), int)
    for tile in tiles(count.shape, (3, 4), (2, 20)):
        part = np.arange(70).reshape(7, 10)[tile.read][tile.inner]
        same(part, np.arange(70).reshape(7, 10)[tile.write])
        count[tile.write] += 1
    assert (count == 1).all()


def test_a_missing_layer_is_named():
    lone = Operator("x.y", lambda volume: volume, (Layer("volume"),))
    with pytest.raises(InputError, match=r"x.y needs volume; there is nothing"):
        lone({})
