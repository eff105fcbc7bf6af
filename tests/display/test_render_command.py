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
        (["--mode", "mop"], "mode-unknown", 10),
        (["--size", "8by6"], "usage", 2),
        (["--size", "0x6"], "usage", 2),
        (["--view", "left"], "usage", 2),
        (["-o", "x.bmp"], "output-kind", 2),
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
