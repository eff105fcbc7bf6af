"""Shader errors name file and line; includes are found; every mode's shaders compile."""

import pytest

from devices.errors import DisplayError
from display.gl import programs


def write(folder, **files):
    for name, text in files.items():
        (folder / f"{name}.glsl").write_text(text, encoding="utf-8")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(programs, "SHADERS", tmp_path)
    programs._text.cache_clear()
    write(tmp_path, vertex="void main() { gl_Position = vec4(0.0); }\n")
    yield tmp_path
    programs._text.cache_clear()


def compiled(renderers, **options):
    return programs.compiled(renderers["gl"].context, "vertex.glsl", "fragment.glsl", **options)


def test_an_error_in_an_included_file_names_that_file_and_line(renderers, folder):
    write(folder, fragment='#include "part.glsl"\nvoid main() {}\n', part="float a;\nfloat b\nfloat c;\n")
    with pytest.raises(DisplayError, match=r"part\.glsl:3") as caught:
        compiled(renderers)
    assert caught.value.code == "shader"


def test_an_error_after_an_include_names_the_including_file(renderers, folder):
    write(folder, fragment='float z;\n#include "part.glsl"\nvoid main() {\n  nonsense();\n}\n', part="float a;\n" * 9)
    with pytest.raises(DisplayError, match=r"fragment\.glsl:4"):
        compiled(renderers)


def test_a_file_is_included_once(renderers, folder):
    write(
        folder,
        fragment='#include "part.glsl"\n#include "part.glsl"\nvoid main() {}\n',
        part="float f() { return 1.0; }\n",
    )
    compiled(renderers)


def test_a_missing_file_is_named(renderers, folder):
    write(folder, fragment='#include "gone.glsl"\nvoid main() {}\n')
    with pytest.raises(DisplayError, match=r"gone\.glsl"):
        compiled(renderers)
