"""Kernel variants, each behind a name: all variants of a group run against each other in one process.

A variant changes names of modules while its renderer is made and its frames are rendered; the first variant of a group
changes nothing, and the others must give its frame. To add one, add a `Variant` to its group in `GROUPS`. When a GPU
has decided, the winner becomes the code and the others are removed.
"""

from __future__ import annotations

import csv
import importlib
import json
import shutil
import statistics
import subprocess
import sys
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import Any
from unittest.mock import patch

import numpy as np
import warp as wp

import lumisplat as ls
from bench.gpu.cubin import resources_of
from bench.gpu.kernel_times import KernelLauncher, counted_load_of, counts
from bench.gpu.worker import Finding, Setting
from bench.presets import Preset, synthetic
from lumisplat.constants import TRAVERSE_STACK_SMALL
from lumisplat.device.bvh.packet import child_entries, packet_of
from lumisplat.device.gaussian.packet_tracing import packet_tracing_of
from lumisplat.device.structs.bvh import Candidate, Node, Particle, Slabs
from lumisplat.renderer.trace import gaussian_trace_kernels, tile_trace_kernels
from lumisplat.renderer.trace.gaussian_trace_kernels import gaussian_trace_kernel
from lumisplat.renderer.trace.tile_trace_kernels import tile_trace_kernel
from lumisplat.runtime.launcher import block_threads

WARM, REPEATS = 2, 7
"""Frames of each variant before the timed ones, and timed frames."""
COUNTED_WIDTH = 240
"""Width of the frame whose loads are counted on the CPU, pixels; bytes of a ray hardly depend on it."""
LAYERS = ("color", "alpha", "normal", "depth")
COUNTERS = {
    "dram__bytes.sum": "DRAM bytes",
    "lts__t_bytes.sum": "L2 bytes",
    "l1tex__t_bytes.sum": "L1 bytes",
    "sm__warps_active.avg.pct_of_peak_sustained_active": "warps active, %",
    "smsp__thread_inst_executed_per_inst_executed.ratio": "threads active",
}
"""Hardware counters that `ncu` reads, and their names in the report."""


@dataclass(frozen=True)
class Variant:
    """One way to write the kernels of a group."""

    name: str
    changes: Mapping[str, object] = field(default_factory=dict[str, object])
    """New values of names, ``module:NAME``."""


@dataclass(frozen=True)
class Group:
    """Variants that do the same."""

    name: str
    config: ls.RenderConfig
    subject: Callable[[Setting], tuple[ls.Scene, ls.Camera]]
    """Returns what is rendered."""
    kernels: Callable[[], Sequence[Any]]
    """Returns the timed kernels, with the variant's changes in force."""
    factories: tuple[Any, ...]
    """Cached functions that make the kernels, and forget them before and after each variant."""
    loads: Mapping[str, Any]
    """Functions that load a struct from global memory, ``module:NAME``, and the struct."""
    variants: tuple[Variant, ...]
    """Variants that all give the frame of the first, to the bit."""


def traced_synthetic(setting: Setting) -> tuple[ls.Scene, ls.Camera]:
    """Returns the synthetic set of the benchmarks, whose camera rays use lists of Gaussians by tiles."""
    count = setting.sizes[0]
    camera = Preset("variants", setting.width, setting.width * 9 // 16, count).camera()
    return ls.Scene(splats=[synthetic(count)]), camera


def traversed_synthetic(setting: Setting) -> tuple[ls.Scene, ls.Camera]:
    """Returns the synthetic set seen through a tiny aperture, with which camera rays traverse BVHs."""
    scene, camera = traced_synthetic(setting)
    return scene, replace(camera, aperture=1e-6, focus_distance=3.0)


TRACER = "lumisplat.renderer.trace.gaussian_trace_kernels"
TRACED = Group(
    name="",
    config=ls.RenderConfig(pipeline=ls.Pipeline.TRACE),
    subject=traversed_synthetic,
    kernels=lambda: [gaussian_trace_kernels.gaussian_trace_kernel(1, TRAVERSE_STACK_SMALL)],
    factories=(packet_of, packet_tracing_of, gaussian_trace_kernel),
    loads={"lumisplat.device.bvh.packet:load_node": Node, f"{TRACER}:load_particle": Particle},
    variants=(Variant("code"),),
)
"""Camera rays through BVHs and sorted hits, without variants."""
TILES = "lumisplat.renderer.trace.tile_trace_kernels"
LISTED = replace(
    TRACED,
    subject=traced_synthetic,
    kernels=lambda: [tile_trace_kernels.tile_trace_kernel(1)],
    factories=(packet_of, packet_tracing_of, tile_trace_kernel),
    loads={f"{TILES}:load_candidate": Candidate, f"{TILES}:load_particle": Particle},
)
"""Camera rays through lists of Gaussians by tiles and sorted hits, without variants."""


def hit_list(slots: int) -> Variant:
    """Returns the tracer with another length of a ray's list of hits."""
    names = ("lumisplat.device.gaussian.packet_tracing", "lumisplat.renderer.trace.gaussian_trace")
    return Variant(f"{slots} hits", {f"{name}:HIT_BUFFER_CUDA": slots for name in names})


def thread_block(threads: int, blocks: int, tracer: str = TRACER) -> Variant:
    """Returns a tracer with another thread block, which also sets how many registers a thread may use."""
    return Variant(f"{threads} threads, {blocks} blocks", {f"{tracer}:PACKET_BOUNDS": (threads, blocks)})


@wp.func
def whole_node_entries(  # noqa: PLR0917
    nodes: wp.array[Node], link: int, group: int, slabs: Slabs, begin: float, hit_distance: int, end: float
):
    """Returns what ``child_entries_of_group`` does; each thread tests all children, as threads on their own do."""
    return child_entries(nodes, link, slabs, begin, hit_distance, end)


TESTED_ALONE = {"lumisplat.device.bvh.packet:child_entries_of_group": whole_node_entries}
STOCHASTIC = replace(TRACED.config, trace=ls.TraceConfig(strategy=ls.config.TraceStrategy.STOCHASTIC_HIT))
GROUPS = {
    group.name: group
    for group in (
        replace(TRACED, name="hit lists", variants=(Variant("code"), *map(hit_list, (16, 24, 48, 64)))),
        replace(
            TRACED,
            name="thread blocks",
            variants=(Variant("code"), thread_block(128, 3), thread_block(128, 6), thread_block(256, 2)),
        ),
        replace(TRACED, name="stochastic hit", config=STOCHASTIC),
        replace(TRACED, name="node tests", variants=(Variant("code"), Variant("alone", TESTED_ALONE))),
        replace(
            LISTED,
            name="lists by tiles",
            variants=(
                Variant("code"),
                *map(hit_list, (16, 48)),
                *(thread_block(*size, TILES) for size in ((128, 3), (128, 6), (256, 2))),
                *(Variant(f"blended after {step}", {f"{TILES}:BLEND_STEP_CUDA": step}) for step in (4, 8, 32)),
            ),
        ),
        replace(LISTED, name="stochastic hit by tiles", config=STOCHASTIC),
    )
}
"""Groups by name; the first variant of each is the code as it stands."""


def compare(setting: Setting, name: str) -> Iterator[Finding]:
    """Times alternating frames of a group's variants, checks their frames, and reports what their kernels need.

    The last findings are tables with a row per variant. Earlier ones keep what is known if a variant fails.
    """
    group = GROUPS[name]
    architectures = setting.architectures or [wp.get_device(setting.device).arch]
    rows = {variant.name: dict[str, object]() for variant in group.variants}
    for variant in group.variants:
        rows[variant.name] |= static(group, variant, architectures)
    yield Finding("compiled", [{"variant": name, **row} for name, row in rows.items()])
    scene, camera = group.subject(setting)
    frames: dict[str, ls.Frame] = {}
    renderers = {variant.name: made(group, variant, setting.device) for variant in group.variants}
    times: dict[str, list[float]] = {variant.name: [] for variant in group.variants}
    repeats = REPEATS if setting.device != "cpu" else 3
    for number in range(WARM + repeats):
        for variant in group.variants:
            renderer, launcher = renderers[variant.name]
            with changed(group, variant):
                launcher.reset()
                frames[variant.name] = renderer.render(scene, camera)
                spent = sum(launcher.kernel_ms[kernel.key] for kernel in group.kernels())
            if number >= WARM:
                times[variant.name].append(spent)
    first = frames[group.variants[0].name]
    rays = camera.width * camera.height
    for variant in group.variants:
        middle = statistics.median(times[variant.name])
        measured = {"kernels, ms": round(middle, 3), "ns a camera ray": round(1e6 * middle / rays, 2)}
        rows[variant.name] = {"variant": variant.name, **measured, **rows[variant.name]}
        apart = difference(frames[variant.name], first)
        yield Finding(f"{variant.name}: largest difference", apart, is_wrong=apart != 0.0)
    yield Finding("variants", list(rows.values()))
    yield Finding("bytes", [{"variant": one.name, **moved_bytes(setting, group, one)} for one in group.variants])


@contextmanager
def changed(group: Group, variant: Variant, **more: object) -> Generator[None]:
    """Puts a variant's changes in force; ``more`` are further ones, by ``module:NAME``."""
    changes = {**variant.changes, **more}
    patches = [patch.object(*target(name), value) for name, value in changes.items()]
    try:
        for one in patches:
            one.start()
        for factory in group.factories:
            factory.cache_clear()
        yield
    finally:
        for one in reversed(patches):
            one.stop()
        for factory in group.factories:
            factory.cache_clear()


def target(name: str) -> tuple[Any, str]:
    """Returns the module and the attribute of ``module:NAME``."""
    module, _, attribute = name.partition(":")
    return importlib.import_module(module), attribute


def made(group: Group, variant: Variant, device: str, **more: object) -> tuple[ls.Renderer, KernelLauncher]:
    """Returns a renderer with a variant's kernels, and its launcher."""
    launcher = KernelLauncher(device)
    with changed(group, variant, **more):
        return ls.Renderer(group.config, launcher), launcher


def static(group: Group, variant: Variant, architectures: Sequence[int]) -> dict[str, object]:
    """Returns registers, stack, shared memory, instructions and occupancy of a variant's kernels, by architecture."""
    with changed(group, variant):
        return {
            f"sm_{architecture}": "; ".join(
                resources_of(kernel.module, architecture)[kernel.key].text(architecture, block_threads(kernel))
                for kernel in group.kernels()
            )
            for architecture in architectures
        }


def difference(frame: ls.Frame, other: ls.Frame) -> float:
    """Returns the largest difference of two frames; infinity if only one of them is finite at a pixel."""
    apart = 0.0
    for layer in LAYERS:
        image, truth = (np.asarray(getattr(one, layer), np.float64) for one in (frame, other))
        both = np.isfinite(image) & np.isfinite(truth)
        if (image[~both] != truth[~both]).any():
            return np.inf
        apart = max(apart, float(np.abs(image[both] - truth[both]).max(initial=0.0)))
    return apart


def moved_bytes(setting: Setting, group: Group, variant: Variant) -> dict[str, object]:
    """Returns the bytes that a variant's kernels move: by hardware counters, or counted on the CPU."""
    if setting.device != "cpu" and shutil.which("ncu"):
        return counters(setting, group, variant)
    small = replace(setting, width=min(setting.width, COUNTED_WIDTH))
    scene, camera = group.subject(small)
    counted = {name: counted_load_of(struct, slot) for slot, (name, struct) in enumerate(group.loads.items())}
    numbers = counts()
    renderer, _ = made(group, variant, "cpu", **counted)
    with changed(group, variant, **counted):
        before = list(numbers)
        renderer.render(scene, camera)
        found = [after - one for one, after in zip(before, numbers, strict=True)]
    rays = camera.width * camera.height
    row: dict[str, object] = {}
    total = 0
    for slot, struct in enumerate(group.loads.values()):
        row[f"{struct.__name__}s a ray (CPU)"] = round(found[slot] / rays, 1)
        total += found[slot] * wp.types.type_size_in_bytes(struct)
    return {**row, "bytes a ray (CPU)": round(total / rays)}


def counters(setting: Setting, group: Group, variant: Variant) -> dict[str, object]:
    """Returns hardware counters of a frame's first launch of each kernel, from a process of its own under ``ncu``."""
    with changed(group, variant):
        keys = "|".join(kernel.key for kernel in group.kernels())
    script = "import sys; from bench.gpu.variants import frame; frame(*sys.argv[1:])"
    command = ["ncu", "--csv", "--page", "raw", "--metrics", ",".join(COUNTERS), "--kernel-name", f"regex:{keys}"]
    command += ["--launch-count", "1", sys.executable, "-c", script, json.dumps(asdict(setting))]
    done = subprocess.run([*command, group.name, variant.name], capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith('"')]
    if len(lines) < 3:  # names, units, values
        return {"ncu": (done.stderr or done.stdout)[-300:]}
    names, units, values = csv.reader(lines[:3])
    found = dict(zip(names, zip(values, units, strict=True), strict=True))
    return {title: " ".join(found[metric]) for metric, title in COUNTERS.items() if metric in found}


def frame(setting: str, group: str, variant: str) -> None:
    """Renders one frame of a variant, for a profiler."""
    given = Setting(**json.loads(setting))
    found = GROUPS[group]
    (wanted,) = (one for one in found.variants if one.name == variant)
    renderer, _ = made(found, wanted, given.device)
    with changed(found, wanted):
        renderer.render(*found.subject(given))
