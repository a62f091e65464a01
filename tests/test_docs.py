"""The pages: their code runs, their commands are real, and every name and link in them exists."""

from __future__ import annotations

import ast
import math
import re
import shlex
import subprocess
import sys
from dataclasses import fields
from functools import reduce
from importlib import import_module
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import tyro

import dsom_jax
import tiny_world
from dsom_jax.data import LogOptions
from dsom_jax.lidar import LidarConfig
from dsom_jax.raycast import cast_rays

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
PAPER = (ROOT / "docs" / "paper_to_code.md").read_text()
LINK = re.compile(r"\[([^\]]*)\]\(([^)#\s]+)\)")
COMMAND = re.compile(r"python -m dsom_jax\.(\w+) ([^`\n]*)")
ARGUMENTS = {"bench": "BenchArgs", "localize": "LocalizeArgs", "demo": "DemoArgs", "certify": "CertifyArgs",
             "train": "TrainArgs", "train_filter": "TrainFilterArgs", "evaluate": "EvaluateArgs",
             "export": "ExportArgs", "ros2": "NodeArgs", "inspect": "InspectArgs"}  # fmt: skip
FOREIGN = {"--clock", "--rate", "--ros-args", "--save", "--system-site-packages"}
"""Options of other programs' commands on the pages: ros2, evo."""


def marked(name: str) -> str:
    """The command between the README's markers ``name``:begin and ``name``:end."""
    (block,) = re.findall(rf"<!-- {name}:begin -->\n```sh\n(.*?)\n```\n<!-- {name}:end -->", README.read_text(), re.S)
    return block


def blocks(page: Path) -> list[str]:
    """Python code of a page."""
    return re.findall(r"```python\n(.*?)```", page.read_text(), re.S)


def arguments(module: str) -> type:
    """The dataclass of a command line."""
    home = {"ros2": "ros2.__main__"}.get(module, module)
    return getattr(import_module(f"dsom_jax.{home}"), ARGUMENTS[module])


def write_map_and_log(folder: Path) -> None:
    """``map.yaml`` and ``drive.log``: the tiny room, and a robot that turns once; its odometry is in the map frame."""
    dsom_jax.save_ros_map(tiny_world.grid(), folder / "map.yaml")
    # What a reader takes a CARMEN scan of 180 readings for.
    lidar = LidarConfig(beams=180, angle_min=-math.pi / 2, angle_increment=math.pi / 180, range_max=8.0)
    turns = jnp.stack([jnp.full(13, 3.1), jnp.full(13, 2.3), 0.6 * jnp.arange(13)], axis=-1)
    poses = tiny_world.grid().from_grid(turns)
    scans = np.minimum(np.asarray(cast_rays(tiny_world.tables(), poses, lidar)), 8.19)
    lines = []
    for t, (pose, scan) in enumerate(zip(np.asarray(poses), scans, strict=True)):
        place = " ".join(f"{v:.4f}" for v in pose)
        lines.append(f"FLASER 180 {' '.join(f'{r:.2f}' for r in scan)} {place} {place} {t} robot {t}\n")
    (folder / "drive.log").write_text("".join(lines))


CLOSER = {
    "README.md": "assert np.median(np.hypot(*(result.info.cluster[:, -1] - log.odometry[-2])[:, :2].T)) < 0.5",
    "quickstart.md": "",
    "ros2.md": "assert answer.localized and np.hypot(*(answer.pose - log.odometry[-1])[:2]) < 0.5",
}
"""What is asserted after the last block of a page: of 13 scans, two segments use the first 12."""


@pytest.mark.parametrize("name", CLOSER)
def test_code_of_the_pages_runs(name, tmp_path, monkeypatch):
    page = next(page for page in PAGES if page.name == name)
    write_map_and_log(tmp_path)
    code = "\n".join([*blocks(page), "import numpy as np", CLOSER[name]])
    monkeypatch.chdir(tmp_path)
    exec(compile(code, str(page), "exec", dont_inherit=True), {"__name__": "page"})


def name_space(name):
    """Modules and names of the stub of a package, from which they are imported lazily and editors read them."""
    tree = ast.parse((Path(dsom_jax.__file__).parent / name / "__init__.pyi").read_text())
    homes = {}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            homes |= {alias.name: node.module for alias in node.names}
    return homes


@pytest.mark.parametrize("name", ["", "filters", "proposals"])
def test_public_names_are_what_the_stub_says(name):
    package = import_module(f"dsom_jax.{name}".rstrip("."))
    homes = name_space(name)
    assert sorted(homes) == sorted(package.__all__) and set(homes) <= set(dir(package))
    for word, module in homes.items():
        home = import_module(f"{package.__name__}.{module}") if module else None
        expected = getattr(home, word) if home else import_module(f"{package.__name__}.{word}")
        assert getattr(package, word) is expected, word
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        _ = package.nothing_of_the_kind
    assert name or 35 <= len(homes) <= 55


@pytest.mark.parametrize("name", ["maps", "logs", "simulate", "nn", "plotting"])
def test_names_of_a_space_are_in_it(name):
    space = import_module(f"dsom_jax.{name}")
    assert space.__all__ and all(hasattr(space, word) for word in space.__all__)


def test_import_is_light():
    code = "import dsom_jax, sys; assert 'jax' not in sys.modules and 'PIL' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for label, target in LINK.findall(page.read_text()):
        assert (page.parent / target).exists(), f"{page.name}: {label} -> {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tests_named_in_the_pages_exist(page):
    for label, target in LINK.findall(page.read_text()):
        if label.startswith("`test_") and not label.endswith(".py`"):
            assert f"\ndef {label.strip('`')}(" in (page.parent / target).read_text(), label


def test_every_function_of_the_paper_map_exists_where_it_says():
    found = [(label.strip("`"), target) for label, target in LINK.findall(PAPER) if ":" in label]
    assert len(found) > 40
    for label, target in found:
        module_name, name = label.split(":")
        module = import_module(f"dsom_jax.{module_name}")
        assert reduce(getattr, name.split("."), module) is not None
        assert Path(module.__file__) == (ROOT / "docs" / target).resolve(), label


def test_the_paper_map_is_complete():
    first = [line.split("|")[1].strip() for line in PAPER.splitlines() if line.startswith("|")]
    wanted = [*(f"Eq {n}" for n in range(1, 16)), *(f"Fig {n}" for n in range(1, 10))]
    wanted += ["Table I", "Table II", "Table III"]
    for item in wanted:
        assert any(re.match(rf"{item}\b", cell) for cell in first), f"{item} of the paper has no row"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_of_the_pages_are_understood(page):
    for module, words in COMMAND.findall(page.read_text()):
        if module in ARGUMENTS and "--help" not in words:
            tyro.cli(arguments(module), args=shlex.split(words))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_options_named_in_the_pages_exist(page):
    kinds = [*map(arguments, ARGUMENTS), LogOptions]
    names = {f.name.replace("_", "-") for kind in kinds for f in fields(kind)}
    known = {f"--{no}{name}" for name in names for no in ("", "no-")}
    for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", page.read_text()):
        assert option in known | FOREIGN | {"--help"}, f"{page.name}: {option}"


def test_exactly_three_commands_do_their_own_setup():
    setup = [line for line in README.read_text().splitlines() if "-m venv" in line]
    assert setup == [marked("demo"), marked("bench-command"), marked("test")]
    assert "-m dsom_jax.demo" in setup[0] and "-m dsom_jax.bench" in setup[1] and setup[2].endswith("-m pytest")


def test_ci_runs_the_command_of_the_readme():
    (extract,) = re.findall(r"^command=.*$", (ROOT / ".ci" / "run").read_text(), re.M)
    done = subprocess.run(
        ["bash", "-c", f'{extract}; printf %s "$command"'], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == marked("test")


def test_constraints_are_versions_only():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert lines == sorted(lines) and all(re.fullmatch(r"[a-z0-9-]+==[\w.]+", line) for line in lines)
