"""``stereotome render``: real files in, pictures out, bad input in one line."""

import cv2
import numpy as np
import pytest

from devices.cli import run


@pytest.fixture
def stack(tmp_path):
    path = tmp_path / "stack.npy"
    np.save(path, np.random.default_rng(1).integers(0, 200, (6, 30, 40), np.uint8))
    return path


def test_a_picture_is_written(stack, tmp_path, capsys):
    out = tmp_path / "x.png"
    assert run(["render", str(stack), "--mode", "mip", "-o", str(out), "--size", "160x120", "--view", "30,20"]) == 0
    assert cv2.imread(str(out)).shape == (120, 160, 3)
    assert str(out) in capsys.readouterr().out


def test_modes_are_listed(capsys):
    assert run(["render", "--list"]) == 0
    assert "mip" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "code", "exit_code"),
    [
        (["--mode", "mop"], "mode-unknown", 2),
        (["--size", "8by6"], "usage", 2),
        (["--size", "0x6"], "usage", 2),
        (["--view", "left"], "usage", 2),
        (["-o", "x.bmp"], "output-kind", 2),
        (["--light", "a,b"], "usage", 2),
        (["--cut", "x=2:1"], "usage", 2),
        (["--fade", "3"], "usage", 2),
        (["--limits", "9,3"], "usage", 2),
        (["--colours", "virids"], "colours-unknown", 10),
        (["--opacity", "gone.csv"], "opacity-table", 2),
        (["--ratio", "0/5"], "usage", 2),
        (["--stereo", "page-flip"], "usage", 2),
        (["--zoom", "0"], "view", 10),
    ],
)
def test_bad_words_get_one_line(stack, tmp_path, capsys, arguments, code, exit_code):
    given = ["render", str(stack), *arguments]
    if "-o" not in arguments:
        given += ["-o", str(tmp_path / "x.png")]
    assert run(given) == exit_code
    assert f"error[{code}]" in capsys.readouterr().err


def test_an_existing_picture_is_kept(stack, tmp_path, capsys):
    out = tmp_path / "x.png"
    out.write_bytes(b"mine")
    assert run(["render", str(stack), "-o", str(out)]) == 2
    assert out.read_bytes() == b"mine"
    assert "output-exists" in capsys.readouterr().err


def test_stereo_and_tables_reach_the_picture(stack, tmp_path):
    table = tmp_path / "table.csv"
    table.write_text("value,opacity,red,green,blue\n0,0,0,0,0\n200,0.5,1,0.5,0\n")
    out = tmp_path / "pair.png"
    options = ["--mode", "translucent", "--opacity", str(table), "--stereo", "parallel", "--size", "60x40", "--plain"]
    assert run(["render", str(stack), "-o", str(out), *options]) == 0
    pair = cv2.imread(str(out))
    assert pair.shape == (40, 120, 3)
    assert pair[..., 2].max() > pair[..., 0].max()
    assert not np.array_equal(pair[:, :60], pair[:, 60:])


@pytest.mark.parametrize("kind", ["mp4", "gif"])
def test_movies_have_their_pictures(stack, tmp_path, capsys, kind):
    out = tmp_path / f"turn.{kind}"
    options = ["--mode", "mip", "--size", "49x36", "--frames", "6", "--bounce", "--fps", "12"]
    assert run(["render", str(stack), "-o", str(out), *options]) == 0
    import av

    with av.open(str(out)) as file:
        pictures = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    assert len(pictures) == 10
    assert pictures[0].shape == (36, 48 if kind == "mp4" else 49, 3)
    assert "drawing: 10 of 10" in capsys.readouterr().err


def test_a_sweep_that_changes_nothing_is_refused(stack, tmp_path, capsys):
    out = tmp_path / "x.mp4"
    assert run(["render", str(stack), "-o", str(out), "--mode", "mip", "--movie", "planes"]) == 2
    assert "error[movie]" in capsys.readouterr().err
    assert not out.exists()


def test_bands_and_their_ratio(tmp_path):
    stack = tmp_path / "bands.npy"
    planes = np.stack([np.full((8, 10), level, np.uint16) for level in (100, 200, 300)])
    planes[:, 0, 0] = 0
    np.save(stack, planes)
    out = tmp_path / "x.png"
    given = [
        "render",
        str(stack),
        "-o",
        str(out),
        "--mode",
        "slice",
        "--planes-are-bands",
        "--plain",
        "--size",
        "20x16",
    ]
    assert run([*given, "--limits", "0,300"]) == 0
    assert cv2.imread(str(out))[8, 10].tolist() == pytest.approx([255, 170, 85], abs=1)
    assert run([*given, "--ratio", "0/1", "--colours", "gray", "--overwrite"]) == 0
    assert (cv2.imread(str(out))[8, 10] == 255).all()


BAD = {
    "empty": (np.zeros((0, 8, 9), np.uint8), "stack-axes"),
    "not numbers": (np.full((3, 8, 9), np.nan, np.float32), "stack-nan"),
    "infinite": (np.full((3, 8, 9), np.inf, np.float32), "stack-nan"),
    "complex": (np.zeros((3, 8, 9), complex), "stack-dtype"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_data_get_one_line(tmp_path, capsys, kind):
    values, code = BAD[kind]
    np.save(tmp_path / "bad.npy", values)
    assert run(["render", str(tmp_path / "bad.npy"), "--mode", "cubes", "-o", str(tmp_path / "x.png")]) in {2, 10}
    assert f"error[{code}]" in capsys.readouterr().err


@pytest.mark.parametrize("values", [np.zeros((4, 8, 9), np.uint8), np.full((1, 8, 9), 7, np.uint8)])
def test_nothing_to_see_and_thick_planes_are_drawn_all_the_same(tmp_path, values):
    np.save(tmp_path / "dull.npy", values)
    given = ["render", str(tmp_path / "dull.npy"), "--step-um", "10", "--mode", "cubes", "--size", "40x30"]
    assert run([*given, "-o", str(tmp_path / "x.png")]) == 0
