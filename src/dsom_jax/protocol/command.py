"""The command: maps one after another, then the report; results that exist are kept."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from dsom_jax import checkpoint, report
from dsom_jax.data import load_map
from dsom_jax.data.suite import Suite
from dsom_jax.errors import UserError
from dsom_jax.filters.methods import network_of
from dsom_jax.protocol.adapting import Site, adapt, adapt_filter
from dsom_jax.protocol.clips import choose
from dsom_jax.protocol.digests import map_digest
from dsom_jax.protocol.plan import ProtocolPlan, Variant, map_file, read_logs, read_plan, variants
from dsom_jax.protocol.reporting import write_report
from dsom_jax.protocol.running import Builder, identity, is_done, run_variant


@dataclass(frozen=True)
class ProtocolArgs:
    """Run one configuration."""

    config: Path
    """Configuration file, such as experiments/real/paper.yaml."""
    data: Path
    """Folder of the data set."""
    out: Path
    """Folder for results, tables and figures."""
    work: Path
    """Folder for adapted networks, which a repetition takes up again, and pictures of runs."""
    checkpoint: Path | None = None
    """DSOM to start from; default: the one in the repository."""
    adapt_minutes: float | None = None
    """Minutes of training DSOM on each map, in place of the configuration's; 0 takes it as it is."""
    adapt_steps: int | None = None
    """Steps of that training in place of minutes."""
    learn_steps: int | None = None
    """Steps of training PF-Net and PFRNN on each map, in place of the configuration's; 0 takes them as they are."""
    runs: int | None = None
    """Monte-Carlo runs of each clip, in place of the configuration's."""
    only: tuple[str, ...] = ()
    """Names of maps; default: all."""


def main(args: ProtocolArgs) -> None:
    """All maps of a configuration."""
    changes = ("runs", "adapt_minutes", "adapt_steps", "learn_steps")
    plan = read_plan(args.config, {name: getattr(args, name) for name in changes})
    if not args.data.is_dir():
        raise UserError(f"--data {args.data}: no such folder; name the folder of the data set")
    if set(args.only) - set(plan.maps):
        raise UserError(f"--only {' '.join(args.only)}: the configuration has {', '.join(plan.maps)}")
    start = start_network(plan, args)
    logs = {name: list(read_logs(plan.on(name)[0], args.data)) for name in args.only or plan.maps}
    out, work = report.output_folder(args.out), report.output_folder(args.work)
    for name in logs:
        one, fields = plan.on(name)
        map_yaml = map_file(name, fields, args.data, work)
        suite = choose(one, logs[name], name, load_map(map_yaml))
        run_map(one, suite, map_yaml, start, name, out, work)
        write_report(plan, out)


def start_network(plan: ProtocolPlan, args: ProtocolArgs) -> Path | None:
    """The network that training begins with, if any method draws from one."""
    start = args.checkpoint or checkpoint.shipped()
    needed = {kind for v in variants(plan) if (kind := network_of(v.method))}
    if start is None and "dsom" in needed:
        raise UserError("--checkpoint: no network is shipped; name the folder of one")
    if missing := [kind for kind in needed - {"dsom"} if checkpoint.shipped(kind) is None]:
        raise UserError(f"{args.config}: methods: no {missing[0]} is shipped; leave it out")
    return start


def run_map(
    plan: ProtocolPlan, suite: Suite, map_yaml: Path, start: Path | None, name: str, out: Path, work: Path
) -> None:
    """What is missing of the results of one map, in ``out``/NAME and ``work``/NAME."""

    site = Site(map_yaml, map_digest(suite.episodes[0][1]), suite.lidar, work / "networks" / name)

    @cache
    def adapted(kind: str, begin: Path) -> Path:
        return adapt(plan, site, begin) if kind == "dsom" else adapt_filter(plan, site, begin, kind)

    def begun(variant: Variant) -> Path | None:
        kind = network_of(variant.method)
        return start if kind == "dsom" else checkpoint.shipped(kind) if kind else None

    def network(variant: Variant) -> Path | None:
        kind, begin = network_of(variant.method), begun(variant)
        return adapted(kind, begin) if kind and begin and not variant.shipped else begin

    folders = report.output_folder(out / name), report.output_folder(work / name)
    build = Builder(plan, suite, network)
    for variant in variants(plan):
        made_of = identity(variant, plan, suite, begun(variant))
        if is_done(variant, made_of, folders[0]):
            print(f"{name}, {variant.stem}: kept", flush=True)
            continue
        run_variant(variant, plan, suite, build, made_of, *folders)
        print(f"{name}, {variant.stem}: done", flush=True)
