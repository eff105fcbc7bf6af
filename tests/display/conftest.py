"""Renderers for all tests of a module; the GL error flag must be down before and after every test."""

import pytest

from display.gl.renderer import Renderer


@pytest.fixture(scope="session")
def renderers():
    """Both executors in one context."""
    with Renderer(executor="gl") as gl:
        yield {"gl": gl, "cpu": Renderer(gl.context, executor="cpu")}


@pytest.fixture(params=["gl", "cpu"])
def renderer(request, renderers):
    """Each executor in turn."""
    chosen = renderers[request.param]
    assert chosen.context.error == "GL_NO_ERROR"
    yield chosen
    assert chosen.context.error == "GL_NO_ERROR"
    chosen.end_frame()
