"""The five package names are ours alone in this environment, and what is shipped is what the layout says."""

import ast
import re
import sys
import tomllib
from importlib.metadata import distribution, entry_points, packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("acquire", "devices", "display", "processing", "sim")


@pytest.mark.parametrize("package", PACKAGES)
def test_no_other_distribution_owns_the_name(package):
    owners = set(packages_distributions().get(package, []))
    assert owners <= {"stereotome"}, f"{owners} also installs '{package}': give Stereotome an environment of its own"


@pytest.mark.parametrize("package", PACKAGES)
def test_the_package_imported_is_the_one_of_this_checkout(package):
    module = __import__(package)
    assert Path(module.__file__).parent == ROOT / package


def test_there_is_no_loose_module_at_the_root():
    assert list(ROOT.glob("*.py")) == []


@pytest.mark.parametrize(
    "group",
    ["stereotome.commands", "stereotome.devices", "stereotome.observers", "stereotome.models", "console_scripts"],
)
def test_every_entry_point_can_be_loaded(group):
    points = [point for point in entry_points(group=group) if point.dist and point.dist.name == "stereotome"]
    assert points
    for point in points:
        assert callable(point.load())


def test_the_installed_version_is_the_one_in_the_project_file():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert distribution("stereotome").version == project["version"]


def test_the_lock_has_hashes_and_names_no_host():
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    packages = re.findall(r"^[a-z][^\n]*==", lock, flags=re.MULTILINE)
    assert len(packages) > 30
    assert lock.count("--hash=sha256:") >= len(packages)
    assert "://" not in lock
    assert not (ROOT / "uv.lock").exists() or "uv.lock" in (ROOT / ".gitignore").read_text(encoding="utf-8")


def test_the_lock_holds_everything_the_project_file_asks_for():
    data = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    asked = [*data["project"]["dependencies"], *data["dependency-groups"]["dev"], *data["build-system"]["requires"]]
    locked = set(
        re.findall(r"^([A-Za-z0-9_.-]+)==", (ROOT / "requirements.lock").read_text("utf-8"), flags=re.MULTILINE)
    )
    assert {re.split(r"[<>=~!\[ ]", name)[0] for name in asked} <= locked


def test_the_bootstrap_script_needs_the_standard_library_only():
    tree = ast.parse((ROOT / "run").read_text(encoding="utf-8"))
    imported = {
        name.partition(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, (ast.Import, ast.ImportFrom))
        for name in ([node.module] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names])
    }
    assert imported <= set(sys.stdlib_module_names) | {"__future__"}
