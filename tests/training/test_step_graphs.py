"""Training steps replayed from a CUDA graph, with CUDA's schedule on the CPU: equal to launched steps to the bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.renderer.raster.binning import BinningParallel
from lumisplat.runtime.downloads import HostHistory
from lumisplat.runtime.launcher import Launcher
from lumisplat.training import trainer as trainer_module
from lumisplat.training.losses import Loss
from lumisplat.training.run_folder import RECORD
from lumisplat.training.trainer import Trainer
from lumisplat.training.views import TargetPixels, TrainingView
from support.compare.driver_calls import GRAPH, LAUNCH, READ, driver_calls
from support.compare.graph_launcher import GraphLauncher
from support.kinds import expect_kind
from support.scenes.training_scenes import BACKGROUND, views

CONFIG = ls.TrainConfig(iterations=70, cap=150, initial=120, sh_degree=1, seed=3)
DENSIFY_EVERY = 20
WARM_STEPS = 12
"""Steps until every view was used, and a step with it is recorded."""
STEADY_STEPS = 40
"""Steps until all terms are active, images have full size, and every kind of view was used three times."""
LAG = 5
"""Number of steps that the host is ahead of the GPU in `LateHistory`."""


def trainer(
    config: ls.TrainConfig, launcher: Launcher, seen: list[TrainingView], monkeypatch: pytest.MonkeyPatch
) -> Trainer:
    """Returns a trainer that runs its kernels by the given launcher, and changes the number of Gaussians often."""
    monkeypatch.setattr(trainer_module, "Launcher", lambda *_: launcher)
    monkeypatch.setattr(trainer_module, "DENSIFY_AFTER", 0)
    monkeypatch.setattr(trainer_module, "DENSIFY_EVERY", DENSIFY_EVERY)
    return Trainer(seen, config, background=BACKGROUND, device="cpu")


def pair(config: ls.TrainConfig, seen: list[TrainingView], monkeypatch: pytest.MonkeyPatch) -> tuple[Trainer, Trainer]:
    """Returns two trainers with CUDA's schedule: one replays graphs, the other launches each kernel and waits."""
    direct = Launcher("cpu", threads=1, parallel=True)
    return trainer(config, GraphLauncher(), seen, monkeypatch), trainer(config, direct, seen, monkeypatch)


def run(one: Trainer, steps: int) -> list[tuple[int, Loss]]:
    """Runs steps and returns their losses."""
    for _ in range(steps):
        one.step()
    return one.take_losses()


def assert_equal(one: Trainer, other: Trainer) -> None:
    """Fails unless all arrays on which the next step depends are equal to the bit."""
    states = one.checkpoint, other.checkpoint
    parts = [
        (state.parameters.values, state.parameters.first, state.parameters.second, state.record, state.per_image)
        for state in states
    ]
    for ours, theirs in zip(*parts, strict=True):
        assert ours.keys() == theirs.keys()
        for name, values in ours.items():
            np.testing.assert_array_equal(values, theirs[name], err_msg=name)


def masked() -> list[TrainingView]:
    """Returns views of which some have pixel weights and some have alpha."""
    rng, found = np.random.default_rng(0), list[TrainingView]()
    for number, view in enumerate(views(8)):
        color = view.read().color
        weight = rng.uniform(size=color.shape[:2]).astype(np.float32) if number % 2 else None
        alpha = rng.uniform(size=color.shape[:2]).astype(np.float32) if number % 3 else None
        pixels = TargetPixels(color, weight, alpha)
        found.append(replace(view, read=lambda pixels=pixels: pixels))
    return found


ADAPTIVE = ls.config.Densification.ADAPTIVE
UNSCENTED = ls.config.Projection.UNSCENTED
TERMS: dict[str, Any] = {"normals": 0.05, "flatness": 0.3, "depth_spread": 0.3, "normal_smoothness": 0.01}
CASES: dict[str, tuple[ls.TrainConfig, Callable[[], list[TrainingView]]]] = {
    "MCMC": (CONFIG, lambda: views(8)),
    "adaptive": (replace(CONFIG, densification=ADAPTIVE, grow_pull=1e-4), lambda: views(8)),
    "coarse images first": (replace(CONFIG, coarse=2), lambda: views(8)),
    "surface terms": (replace(CONFIG, **TERMS), lambda: views(8)),
    "adaptive by normals": (replace(CONFIG, densification=ADAPTIVE, normals=0.1, grow_turn=0.004), lambda: views(8)),
    "exposures and poses": (replace(CONFIG, exposures=True, refine_poses=True), lambda: views(8)),
    "masks and alpha": (replace(CONFIG, mask_entropy=0.1, normals=0.1), masked),
    "random background": (replace(CONFIG, random_background=True), masked),
    "unscented": (replace(CONFIG, projection=UNSCENTED, refine_poses=True), lambda: views(8)),
    "rays": (replace(CONFIG, pipeline=ls.Pipeline.TRACE), lambda: views(8)),
}


@pytest.mark.parametrize("name", CASES)
def test_replayed_steps_equal_launched_steps_to_the_bit(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """All that changes between steps does so, also the number of Gaussians; the losses are equal, too."""
    config, seen = CASES[name]
    graphs, direct = pair(config, seen(), monkeypatch)
    steps = DENSIFY_EVERY + WARM_STEPS
    assert run(graphs, steps) == run(direct, steps)
    assert_equal(graphs, direct)
    assert graphs.count != CONFIG.initial


@pytest.mark.parametrize("name", [name for name in CASES if name not in ("random background", "rays")])
def test_steady_step_is_one_graph_without_a_launch(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The host reads only the gradients of exposures and poses."""
    config, seen = CASES[name]
    one = trainer(config, GraphLauncher(), seen(), monkeypatch)
    monkeypatch.setattr(trainer_module, "DENSIFY_EVERY", CONFIG.iterations)
    run(one, STEADY_STEPS)
    with driver_calls() as counts:
        one.step()
    assert counts[GRAPH] == 1 and counts[LAUNCH] == 0
    assert counts[READ] == 2 * config.exposures + config.refine_poses


class LateHistory(HostHistory):
    """Host memory in which copies appear as late as from a GPU that is `LAG` steps behind."""

    def __init__(self, *sizes: Any) -> None:
        super().__init__(*sizes)
        self._queued: list[tuple[int, np.ndarray]] = []

    def add(self, number: int, source: Any) -> None:
        """Copies an array as it is now, but shows the copy later."""
        self._queued.append((number, np.array(source.numpy())))
        self._show(LAG)

    def wait(self) -> None:
        """Shows all copies."""
        self._show(0)

    def _show(self, left: int) -> None:
        while len(self._queued) > left:
            number, words = self._queued.pop(0)
            self[number][: len(words)] = words


def late(config: ls.TrainConfig, seen: list[TrainingView], monkeypatch: pytest.MonkeyPatch) -> tuple[Trainer, Trainer]:
    """Returns trainers as `pair` does; the host of the first one is ahead of its GPU."""
    graphs, direct = pair(config, seen, monkeypatch)
    history = LateHistory("cpu", graphs._history.length, graphs._history.values.shape[1])
    monkeypatch.setattr(graphs, "_history", history)
    monkeypatch.setattr(graphs._launcher, "synchronize", history.wait)
    return graphs, direct


def on_host(one: Trainer) -> list[np.ndarray]:
    """Returns copies of all parameters, their moments and the statistics, which a stopped step must not change."""
    on, record = one._device_splats, one._record
    structs: list[Any] = [on.values, on.first, on.second]
    held = [
        getattr(struct, name) for struct in structs for name in ("means", "rotations", "log_scales", "logits", "sh")
    ]
    return [np.array(array.numpy()) for array in (*held, *(getattr(record, name) for name in RECORD))]


@pytest.mark.parametrize("name", ["MCMC", "adaptive by normals", "unscented"])
def test_step_whose_tile_lists_are_too_short_is_repeated_with_all_that_followed_it(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The host notices late; until then, nothing changes on the device, and afterwards nothing is missing."""
    config = replace(CASES[name][0], refine_poses=False)
    graphs, direct = late(config, views(8), monkeypatch)
    for one in (graphs, direct):
        logits: Any = one._device_splats.values.logits
        logits.numpy()[::3] = -5.0  # so transparent that MCMC moves them
    assert run(graphs, DENSIFY_EVERY + 2) == run(direct, DENSIFY_EVERY + 2)
    before, binning = on_host(graphs), expect_kind(BinningParallel, graphs._backend._binning)
    binning._set_capacity("raster", 40)
    binning.growth += 1
    growth = binning.growth
    for _ in range(LAG):
        graphs.step()
    assert binning.growth == growth, "the host cannot know yet"
    for now, then in zip(on_host(graphs), before, strict=True):
        np.testing.assert_array_equal(now, then)
    graphs.step()
    assert binning.growth > growth, "the host has seen the first loss"
    assert run(graphs, 6) == run(direct, LAG + 7)
    assert_equal(graphs, direct)


def test_loss_that_is_not_finite_is_reported_with_its_iteration_and_changes_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The host may have launched further iterations meanwhile."""
    seen = views(8)
    graphs, direct = late(CONFIG, seen, monkeypatch)
    assert run(graphs, 8) == run(direct, 8)
    broken = TargetPixels(np.full((40, 40, 3), np.nan, np.float32))
    third = graphs._number_of(11)
    seen[third] = replace(seen[third], read=lambda: broken)
    assert graphs._kept is not None
    del graphs._kept[third]
    run(direct, 3)
    for _ in range(7):
        graphs.step()
    with pytest.raises(ls.training.DivergedError, match=r"^training stopped at iteration 12: the loss is nan"):
        graphs.take_losses()
    with pytest.raises(ls.training.DivergedError, match=r"^training stopped at iteration 12: the loss is nan"):
        direct.step()
    assert_equal(graphs, direct)
