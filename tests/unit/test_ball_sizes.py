"""Sizes of balls from circles against known sizes, and picked lines against geometry."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from devices.cli import run
from devices.errors import InputError
from processing.circles import ball_sizes
from processing.picked import Picked
from processing.unfold import kernel, unfold


def circles_of(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Balls of lognormal sizes, and the circles of random cuts through them: large ones are hit more often."""
    rng = np.random.default_rng(seed)
    balls = rng.lognormal(np.log(10), 0.3, 100_000)
    hit = rng.choice(balls, count, p=balls / balls.sum())
    return balls, hit * np.sqrt(1 - rng.random(count) ** 2)


@pytest.mark.parametrize("count", [500, 1000, 5000])
def test_sizes_are_nearer_to_the_truth_than_by_saltykov(count: int) -> None:
    wrong = {"ems": [], "saltykov": []}
    for seed in (101, 102, 103):  # sizes on which nothing was chosen
        balls, circles = circles_of(seed, count)
        for method, found in wrong.items():
            made = unfold(circles, count / balls.mean(), method=method)
            truth = np.histogram(balls, made.edges_um)[0] / len(balls)
            found.append(np.abs(made.per_um3 / made.per_um3.sum() - truth).sum() / 2)
            if method == "ems":
                assert made.per_um3.sum() == pytest.approx(1, rel=0.15)
                assert made.mean_um == pytest.approx(balls.mean(), rel=0.08)
    assert np.mean(wrong["ems"]) < 0.85 * np.mean(wrong["saltykov"])


def test_bars_are_the_scatter_of_specimens() -> None:
    edges = np.linspace(0, 30, 16)
    made = [unfold(circles_of(seed, 400)[1], 40.0, edges_um=edges) for seed in range(200, 212)]
    scatter = np.std([m.mean_um for m in made], ddof=1)
    assert 0.5 < np.median([m.mean_error_um for m in made]) / scatter < 2


def test_all_circles_of_a_ball_are_in_some_class() -> None:
    edges = np.linspace(0, 10, 11)
    assert kernel(edges, upper=True).sum(axis=0) == pytest.approx(edges[1:])
    assert kernel(edges).sum(axis=0) == pytest.approx((edges[1:] + edges[:-1]) / 2, rel=1e-3)


def test_circles_of_planes_give_the_balls_of_a_volume() -> None:
    rng, labels = np.random.default_rng(3), np.zeros((60, 120, 120), np.uint32)
    z, y, x = np.ogrid[:60, :120, :120]
    places: list[np.ndarray] = []
    while len(places) < 60:
        place = rng.uniform(0, labels.shape)
        if all(np.linalg.norm(place - other) > 15 for other in places):
            places.append(place)
            labels[(z - place[0]) ** 2 + (y - place[1]) ** 2 + (x - place[2]) ** 2 <= 49] = len(places)
    made = ball_sizes(labels, (2.0, 2.0, 2.0))
    assert made.found.mean_um == pytest.approx(28, rel=0.1)
    truth = 60 / labels.size / 8
    assert made.direct_per_um3.sum() == pytest.approx(truth, rel=0.25)
    assert made.found.per_um3.sum() == pytest.approx(truth, rel=0.3)


@pytest.mark.parametrize("circles", [np.ones(3), np.full(20, -1.0), np.full(20, np.nan)])
def test_too_few_or_no_circles_are_refused(circles) -> None:
    with pytest.raises(InputError) as refused:
        unfold(circles, 1.0)
    assert refused.value.code == "circles"


def test_lengths_angles_and_profiles_are_in_um() -> None:
    line = Picked("corner", np.array([[0, 0, 0], [0, 0, 6], [2, 0, 6]], float))
    spacing = (2.0, 1.0, 0.5)
    assert line.length_um(spacing) == 3 + 4
    assert line.angles_deg(spacing) == pytest.approx([90])
    ramp = np.broadcast_to(np.arange(8.0), (4, 3, 8))
    at, values = line.profile(ramp, spacing)
    assert at[-1] == 7
    assert values == pytest.approx(np.minimum(at / 0.5, 6))


def test_the_command_writes_ball_sizes_and_picked_lines(tmp_path, capsys) -> None:
    rng, grey = np.random.default_rng(5), np.zeros((30, 60, 60), np.uint8)
    z, y, x = np.ogrid[:30, :60, :60]
    for place in rng.uniform(0, grey.shape, (14, 3)):
        grey[(z - place[0]) ** 2 + (y - place[1]) ** 2 + (x - place[2]) ** 2 <= 20] = 200
    np.save(tmp_path / "balls.npy", grey)
    (tmp_path / "points.csv").write_text("name,z,y,x\nedge,0,0,0\nedge,0,0,10\n")
    arguments = ["measure", str(tmp_path / "balls.npy"), "-o", str(tmp_path / "out"), "--quiet", "--pixel-um", "0.5"]
    assert run([*arguments, "--step-um", "0.5", "--balls", "--points", str(tmp_path / "points.csv")]) == 0
    rows = list(csv.DictReader((tmp_path / "out" / "picked.csv").read_text().splitlines()))
    assert float(rows[0]["length_um"]) == 5
    sizes = list(csv.DictReader((tmp_path / "out" / "ball_sizes.csv").read_text().splitlines()))
    assert len(sizes) == 15
    assert (tmp_path / "out" / "report.html").read_text().count("data:image/png") == 5


@pytest.mark.parametrize("words", ["name,z,y\na,1,2\n", "name,z,y,x\na,1,1,1\n", "name,z,y,x\na,1,1,one\n", ""])
def test_bad_points_are_one_clear_line(words: str, tmp_path, capsys) -> None:
    np.save(tmp_path / "grey.npy", np.arange(60, dtype=np.uint8).reshape(3, 4, 5))
    (tmp_path / "points.csv").write_text(words)
    wish = ["--points", str(tmp_path / "points.csv"), "--quiet"]
    assert run(["measure", str(tmp_path / "grey.npy"), "-o", str(tmp_path / "out"), *wish]) == 2
    assert "error[points]" in capsys.readouterr().err
