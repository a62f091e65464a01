"""Networks and training states on disk: an orbax folder and a readable ``provenance.json`` beside it.

A checkpoint is a folder with ``provenance.json``, which says what the network is and names the folder with its
weights. Both are written under other names and renamed, the json last, so that a reader never meets half of one.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import orbax.checkpoint.experimental.v1 as ocp
from flax import nnx

from dsom_jax.atomic import sync_tree, write_atomic
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig
from dsom_jax.nn import KINDS, evaluation_view, kind_of
from dsom_jax.training.options import override

_T = TypeVar("_T")
PROVENANCE = "provenance.json"
DRAFT = ".orbax-checkpoint-tmp"
"""What orbax adds to the name of a folder until it is complete."""
FORMAT = 1
JSON_BYTES = 2**24
"""No record of ours comes near; a larger file is something else."""
SHIPPED = next(
    (folder for up in (2, 0) if (folder := Path(__file__).parents[up] / "checkpoints" / "dsom").is_dir()),
    Path(__file__).parents[2] / "checkpoints" / "dsom",
)
"""The network that comes with the package: in the repository beside ``src``, once installed in the package itself."""


def shipped(kind: str = "dsom") -> Path | None:
    """The folder of the network of that kind that comes with the package, if there is one."""
    folder = SHIPPED.with_name(kind.replace("_", "-"))
    return folder if (folder / PROVENANCE).is_file() else None


def save(directory: str | Path, model: Any, provenance: dict[str, Any] | None = None, **how: Any) -> None:
    """:func:`write` a checkpoint and remove the weights of the one that it replaces; nothing else is touched."""
    replaced = tag_of(directory)
    if replaced not in (None, write(directory, model, provenance, **how)):
        remove_tree(Path(directory) / str(replaced))


def write(
    directory: str | Path,
    model: Any,
    provenance: dict[str, Any] | None = None,
    tag: str = "weights",
    half: bool = False,
) -> str:
    """Write ``model`` as a checkpoint; in one atomic step it takes the place of an older one, whose weights stay.

    Args:
        directory: the checkpoint's folder, made if it does not exist.
        model: a network of :data:`dsom_jax.nn.KINDS`; of a DSOM the training mode or the evaluation view.
        provenance: JSON-able facts to keep: seed, commit, data, metrics.
        tag: name of the folder of the weights; must differ from that of the checkpoint replaced.
        half: store the weights in half precision; statistics stay as they are, and both are read as float32.

    Returns ``tag``.
    """
    directory = Path(directory).absolute()
    what = {"kind": kind_of(model.config), "model": asdict(model.config)}
    record = {"format": FORMAT, **what, "weights": tag, "packages": packages()}
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{directory}: cannot write the checkpoint ({error.strerror}); give another folder") from error
    _save_tree(directory / tag, _halved(_weights(model)) if half else _weights(model))
    write_record(directory / PROVENANCE, {**record, **(provenance or {})})
    return tag


def load(
    directory: str | Path, lidar: LidarConfig | None = None, resolution: float | None = None, kind: str = "dsom"
) -> Any:
    """The network of a checkpoint, a DSOM as an evaluation view.

    Args:
        directory: of the checkpoint.
        lidar: refuse a network that was not trained for such scans.
        resolution: refuse a network for another scale, metres per cell.
        kind: refuse any other network; a name of :data:`dsom_jax.nn.KINDS`.
    """
    record = load_provenance(directory, kind)
    config = _model_config(Path(directory), record, kind)
    _check_fit(Path(directory), config, lidar, resolution)
    abstract = nnx.eval_shape(lambda: KINDS[kind].create(config))
    weights = _load_tree(Path(directory).absolute() / str(record["weights"]), _weights(abstract))
    graphdef = nnx.split(abstract, nnx.Param, nnx.BatchStat)[0]
    model = nnx.merge(graphdef, weights["params"], weights["stats"])
    return evaluation_view(model) if kind == "dsom" else model


def load_provenance(directory: str | Path, kind: str = "dsom") -> dict[str, Any]:
    """The facts of a checkpoint of that kind: what it is, and what it was trained with and on."""
    path = Path(directory) / PROVENANCE
    if not path.is_file():
        raise UserError(f"{path}: no such file; give a folder written by `python -m {KINDS[kind].command} --out`")
    record = read_record(path, "restore the file or train again")
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise UserError(f"{path}: field format is not {FORMAT}; this is not a checkpoint of this version, train again")
    for name in ("model", "weights"):
        if name not in record:
            raise UserError(f"{path}: field {name} is missing; restore the file or train again")
    held = record.get("kind", "dsom")
    if held != kind:
        raise UserError(f"{path}: field kind is {held}, but a {kind} is needed; give the folder of one")
    return record


def digest(directory: str | Path) -> str:
    """Twelve hexadecimal digits of the provenance of a checkpoint, which no other training shares."""
    path = Path(directory) / PROVENANCE
    if not path.is_file():
        raise UserError(f"{path}: no such file; give the folder of a checkpoint")
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


def tag_of(directory: str | Path) -> str | None:
    """Name of the folder of the weights that the checkpoint in ``directory`` consists of; None without a checkpoint."""
    path = Path(directory) / PROVENANCE
    try:
        tag = read_record(path, "")["weights"] if path.is_file() else None
    except (UserError, KeyError, TypeError, IndexError):
        return None
    # Weights lie in the folder itself: a name that leads elsewhere is none.
    return tag if isinstance(tag, str) and tag == Path(tag).name and tag not in ("", ".", "..") else None


def save_state(directory: str | Path, state: Any) -> None:
    """Write any pytree of arrays; the folder must not exist. Atomic."""
    _save_tree(Path(directory).absolute(), state)


def load_state(directory: str | Path, like: _T) -> _T:
    """Read a pytree that has the structure, shapes and dtypes of ``like``."""
    return _load_tree(Path(directory).absolute(), like)


def write_record(path: Path, record: Any) -> None:
    """Write JSON so that ``path`` holds the old or the new text, never a part."""
    write_atomic(path, (json.dumps(record, indent=2) + "\n").encode())


def read_record(path: Path, advice: str) -> Any:
    """The record in a JSON file; UserError, ending in ``advice``, for one that cannot be read or is none."""
    try:
        if path.stat().st_size > JSON_BYTES:
            raise UserError(f"{path}: has more than {JSON_BYTES // 2**20} MiB; {advice}")
        return json.loads(path.read_bytes())
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); {advice}") from error
    except RecursionError:
        raise UserError(f"{path}: not JSON that can be read (nested too deeply); {advice}") from None
    except ValueError as error:  # not JSON, not UTF-8, or a number of too many digits
        raise UserError(f"{path}: not JSON ({str(error)[:120]}); {advice}") from None


def remove_tree(folder: Path) -> None:
    """Remove a folder of weights or of a state; a link in its place is left alone."""
    if folder.is_dir() and not folder.is_symlink():
        shutil.rmtree(folder, ignore_errors=True)


def packages() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    return {name: version(name) for name in ("jax", "flax", "optax", "orbax-checkpoint", "numpy")}


def _weights(model: Any) -> dict[str, Any]:
    parts: Any = nnx.split(model, nnx.Param, nnx.BatchStat)
    _, params, stats = parts
    return {"params": nnx.to_pure_dict(params), "stats": nnx.to_pure_dict(stats)}


def _halved(weights: dict[str, Any]) -> dict[str, Any]:
    return {**weights, "params": jax.tree.map(lambda x: x.astype(jnp.float16), weights["params"])}


def _save_tree(path: Path, tree: Any) -> None:
    """Orbax writes under a temporary name and renames, which makes it atomic; it is on the disk when this returns."""
    with _quiet():
        try:
            ocp.save(path, tree, overwrite=True)
            sync_tree(path)
        except Exception as error:  # orbax and tensorstore raise many kinds
            remove_tree(path.with_name(path.name + DRAFT))  # of which a full disk has most need
            reason = "the disk is full" if "no space left" in str(error).lower() else _first_line(error)
            raise UserError(
                f"{path}: cannot be written ({reason}); what was saved before is intact; free some space, "
                "or give another folder"
            ) from None


@contextmanager
def _quiet() -> Iterator[None]:
    """Without absl's log, where orbax says what it also raises."""
    chatter = logging.getLogger("absl")
    level = chatter.level
    chatter.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        chatter.setLevel(level)


def _load_tree(path: Path, like: _T) -> _T:
    if not path.is_dir():
        raise UserError(f"{path}: the folder of the weights is missing; copy the whole checkpoint or train again")
    abstract = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), like)
    with _quiet(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sharding info not provided")  # one device or many: as it comes
        try:
            tree = ocp.load(path, abstract)
        except Exception as error:  # orbax and tensorstore raise many kinds; all mean that the files do not fit
            reason = f"weights are damaged or of another configuration ({_first_line(error)})"
            raise UserError(f"{path}: {reason}; train again") from error
    for new, old in zip(jax.tree.leaves(tree), jax.tree.leaves(like), strict=True):
        if new.shape != old.shape:
            raise UserError(f"{path}: weights {new.shape} where the configuration has {old.shape}; train again")
    return tree


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:120]


def _model_config(directory: Path, record: dict[str, Any], kind: str) -> Any:
    known = {field.name for field in fields(KINDS[kind].config)}
    path = directory / PROVENANCE
    model = record["model"]
    if not isinstance(model, dict) or set(model) - known:
        raise UserError(f"{path}: field model does not describe a network of this version; train again")
    return override(KINDS[kind].config(), model, f"{path}: field model")


def _check_fit(directory: Path, config: Any, lidar: LidarConfig | None, resolution: float | None) -> None:
    misfit = config.misfit(lidar) if lidar is not None else None
    if misfit:
        raise UserError(f"{directory}: does not fit the lidar: {misfit}; train for it or use another proposal")
    if resolution is not None and abs(resolution - config.resolution) > 1e-3 * config.resolution:
        raise UserError(
            f"{directory}: the network works at {config.resolution:.4g} m per cell, the map has {resolution:.4g};"
            " resample the map to the network's scale"
        )
