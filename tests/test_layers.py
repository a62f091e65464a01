"""The layers of the package: imports point down only, and the mathematics touches neither files nor pictures."""

from __future__ import annotations

import ast
import itertools
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

import dsom_jax

ROOT = Path(dsom_jax.__file__).parent
LAYERS = (
    ("types", "geometry", "errors", "checks", "compiling"),
    ("occupancy", "lidar", "marching", "raycast", "resampling", "pose_grid", "episode"),
    ("motion", "sensor", "nn", "simulate"),
    ("proposals",),
    ("belief",),
    ("filters", "training", "montecarlo", "ambiguity"),
    (
        "atomic",
        "cache",
        "data",
        "checkpoint",
        "run_folder",
        "run_resume",
        "trained",
        "plotting",
        "report",
        "summary_table",
        "judging",
        "view",
        "maps",
        "logs",
        "diagnosis",
    ),
    ("live",),
    (
        "__main__",
        "cli",
        "trainer",
        "train",
        "train_filter",
        "bench",
        "localize",
        "localize_args",
        "inspect",
        "demo",
        "certify",
        "evaluate",
        "export",
        "protocol",
        "ros2",
    ),
)
DEVICE = 6
"""Layers below this are device code."""
LAYER = {name: level for level, names in enumerate(LAYERS) for name in names}
BANNED_IMPORTS = {
    "orbax", "cv2", "matplotlib", "PIL", "pathlib", "os", "io", "shutil", "tempfile", "glob", "json", "yaml", "tomllib",
    "pickle", "csv", "gzip", "zipfile", "subprocess", "rich", "tyro", "rosbags",
}  # fmt: skip
BANNED_CALLS = {
    "open", "input", "load", "save", "savez", "savez_compressed", "loadtxt", "savetxt", "genfromtxt", "fromfile",
    "tofile", "memmap", "read_text", "read_bytes", "write_text", "write_bytes", "mkdir", "unlink",
}  # fmt: skip
MODULES = sorted(ROOT.rglob("*.py"))


def module_name(path: Path) -> str:
    """Dotted name inside the package: ``filters.adam``; the package itself is empty."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def layer(module: str) -> int:
    """Layer of a module; the package's own ``__init__`` is above everything."""
    return LAYER[module.split(".")[0]] if module else len(LAYERS)


def absolute(node: ast.ImportFrom, path: Path) -> str:
    """The module that ``from ... import`` names, relative forms resolved."""
    if not node.level:
        return node.module or ""
    package = ("dsom_jax", *path.relative_to(ROOT).parts[:-1])
    return ".".join([*package[: len(package) - node.level + 1], *filter(None, [node.module])])


def imports(path: Path, tree: ast.AST) -> Iterator[str]:
    """Dotted names of everything imported anywhere in a file, also inside functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = absolute(node, path)
            yield from (f"{base}.{alias.name}" if is_module(f"{base}.{alias.name}") else base for alias in node.names)


def is_module(name: str) -> bool:
    """Whether ``from package import name`` names a module of the package rather than something in it."""
    place = ROOT.parent.joinpath(*name.split("."))
    return place.is_dir() or place.with_suffix(".py").is_file()


def internal(path: Path, source: str) -> Iterator[str]:
    """Modules of the package that a file imports, without the leading ``dsom_jax``."""
    for name in imports(path, ast.parse(source)):
        if name.split(".")[0] == "dsom_jax":
            yield name.removeprefix("dsom_jax").removeprefix(".")


def upward(path: Path, source: str) -> list[str]:
    """Imports that point up."""
    own = layer(module_name(path))
    return [name for name in internal(path, source) if layer(name) > own]


def host_things(source: str) -> list[str]:
    """Libraries and calls of the host that device code may not use."""
    tree = ast.parse(source)
    found = [name for name in imports(ROOT / "x.py", tree) if name.split(".")[0] in BANNED_IMPORTS]
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            found += [name] if name in BANNED_CALLS else []
    return found


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_imports_point_down(path):
    top = module_name(path).split(".")[0]
    assert not top or top in LAYER, f"{top} belongs to no layer: add it to LAYERS (docs of the layout: README)"
    assert upward(path, path.read_text()) == []


@pytest.mark.parametrize("path", [p for p in MODULES if layer(module_name(p)) < DEVICE], ids=module_name)
def test_device_code_knows_no_host(path):
    assert host_things(path.read_text()) == []


def test_no_import_cycles():
    graph = {module_name(path): set(internal(path, path.read_text())) for path in MODULES if module_name(path)}
    done: set[str] = set()

    def visit(module: str, trail: tuple[str, ...]) -> None:
        assert module not in trail, " -> ".join((*trail, module))
        if module not in done:
            for other in graph.get(module, ()):
                visit(other, (*trail, module))
            done.add(module)

    for module in graph:
        visit(module, ())


TWICE = {
    "main": "every command has one",
    **dict.fromkeys(("certify", "inspect", "localize", "train"), "a command in __main__.py, and what it does"),
    **dict.fromkeys(("compose", "relative", "inverse"), "for NumPy in data/se2.py, for JAX in geometry.py"),
}
"""Public names that may stand in several modules, and why: they are one thing."""


def public_names(source: str) -> set[str]:
    """Functions, classes and constants that a module defines for others."""
    found: set[str] = set()
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = (node for target in targets for node in ast.walk(target) if isinstance(node, ast.Name))
            found |= {name.id for name in names if isinstance(name.ctx, ast.Store)}
    return {name for name in found if not name.startswith("_")}


def defined_twice(sources: dict[str, str]) -> dict[str, list[str]]:
    """Public names that several modules define -> those modules."""
    where: dict[str, list[str]] = {}
    for module, source in sources.items():
        for name in public_names(source):
            where.setdefault(name, []).append(module)
    return {name: modules for name, modules in where.items() if len(modules) > 1}


def test_a_public_name_means_one_thing():
    twice = defined_twice({module_name(path): path.read_text() for path in MODULES})
    assert {name: modules for name, modules in twice.items() if name not in TWICE} == {}
    assert set(TWICE) <= set(twice), "take out of TWICE what stands in one module by now"


@pytest.mark.parametrize("line", ["def f(): ...", "class f: ...", "f = 1", "f: int = 1", "f, g = 1, 2"])
def test_a_name_defined_twice_is_seen(line):
    assert defined_twice({"a": line, "b": "def f(): ..."}) == {"f": ["a", "b"]}


@pytest.mark.parametrize("line", ["from b import f", "_f = 1", "x.f = 1", "f[0] = 1", "def g():\n    f = 1"])
def test_a_name_defined_once_is_passed_over(line):
    assert defined_twice({"a": line, "b": "def f(): ..."}) == {}


@pytest.mark.parametrize(
    ("where", "line"),
    [
        ("geometry.py", "from dsom_jax.lidar import LidarConfig"),
        ("proposals/hybrid.py", "from dsom_jax.judging import metrics"),
        ("nn/dsom.py", "from ..filters.adam import adam"),
        ("sensor.py", "def f():\n    import dsom_jax.proposals.dsom"),
        ("filters/adam.py", "from dsom_jax import report as r"),
    ],
)
def test_an_upward_import_is_seen(where, line):
    assert upward(ROOT / where, line)


@pytest.mark.parametrize(
    "line", ["import cv2", "from orbax.checkpoint import v1", "x = np.load(f)", "open('a')", "import matplotlib.pyplot"]
)
def test_host_code_is_seen(line):
    assert host_things(line)


def test_one_robot_needs_no_pictures():
    """What runs on a robot loads neither what draws pages nor what reads bags."""
    words = [sys.executable, "-c", "import sys, dsom_jax.live; print(*sys.modules)"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert not {"matplotlib", "rosbags", "scipy.signal"} & set(done.stdout.split())


NOT_INSTALLED = {"rerun": ["rerun-sdk"]}
"""Distribution of what is imported only where an extra has been asked for."""


def declared() -> set[str]:
    """Distributions that pyproject.toml installs with the package, with or without an extra of its users."""
    project = tomllib.loads((ROOT.parents[1] / "pyproject.toml").read_text())["project"]
    extras = (lines for name, lines in project["optional-dependencies"].items() if name not in ("test", "docs"))
    asked = [*project["dependencies"], *itertools.chain.from_iterable(extras)]
    return {re.split(r"[^\w.-]", line)[0].lower() for line in asked}


@pytest.mark.parametrize("path", [path for path in MODULES if "ros2" not in path.parts], ids=module_name)
def test_what_is_imported_is_declared(path):
    """A library that stands on this machine alone, or that another library brings, may be missing on the next."""
    tops = {name.split(".")[0] for name in imports(path, ast.parse(path.read_text()))}
    for top in tops - {"dsom_jax", "__future__"} - set(sys.stdlib_module_names):
        owners = {name.lower() for name in packages_distributions().get(top, NOT_INSTALLED.get(top, [top]))}
        assert owners & (declared() | {"jaxlib"}), f"{top} is of {owners}, which pyproject.toml does not declare"
