"""A training that was stopped and resumed equals an uninterrupted one bit for bit."""

import random
import shutil
import signal
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import pytest
import torch
from hand_given import BOTH_GOALS, HandGiven
from helpers import check_same, check_same_checkpoint, house, make_training, seed_everything, table

from hdrqn_torchrl.discovery import Chosen
from hdrqn_torchrl.envs import make_gym, make_minigrid
from hdrqn_torchrl.learning import PhaseOne
from hdrqn_torchrl.runs.interruption import Interrupted
from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints

BATCH = 32  # frames; see make_training


def door_and_key(num_envs, seed=0):
    pytest.importorskip("minigrid")
    return make_minigrid("MiniGrid-DoorKey-5x5-v0", num_envs, max_steps=7, seed=seed)


def cart_and_pole(num_envs, seed=0):
    return make_gym("CartPole-v1", num_envs, max_steps=7, seed=seed)


FINDING = HandGiven(
    max_subgoals=2,
    warmup_frames=BATCH,
    discovery_frames=2 * BATCH,
    chosen=(Chosen({1: 1}), BOTH_GOALS, Chosen({2: 1}, once=(1,))),
)
TRAININGS = {
    "drqn": partial(make_training, name="drqn", learner={"sampling": "episodes", "max_grad_norm": 0.5}),
    "v1": partial(
        make_training,
        name="v1",
        learner={"learning_rate_end": 1e-3, "learning_rate_frames": 200, "slice_len": 2, "loss_function": "smooth_l1"},
    ),
    "v2": partial(make_training, name="v2"),
    "v2-odd": partial(make_training, name="v2", learner={"capacity": 43}),  # no multiple of the four environments
    "v2-refreshed": partial(make_training, name="v2", options={"refresh_hidden_steps": 7}),
    "v2-hindsight": partial(
        make_training,
        name="v2",
        learner={"trace_decay": 0.5},
        options={"sub_hindsight": True, "meta_hindsight": True, "meta_input_time": "after_last_observation"},
    ),
    "v2-phases": partial(make_training, name="v2", options={"phase_one": PhaseOne(max_frames=64)}),
    "v1-three-levels": partial(make_training, name="v1", worlds=house, options={"levels": 3}),
    "v2-three-levels": partial(
        make_training, name="v2", worlds=house, options={"levels": 3, "refresh_hidden_steps": 7, "sub_hindsight": True}
    ),
    "v3": partial(make_training, name="v3"),
    "v3-three-levels": partial(make_training, name="v3", worlds=house, options={"levels": 3}),
    "v1-r2d2": partial(
        make_training, name="v1", learner={"stored_state": True, "priority_exponent": 0.9, "slice_len": 2}
    ),
    "v2-whole": partial(
        make_training, name="v2", learner={"sampling": "whole_episodes", "slice_len": 3, "priority_exponent": 0.5}
    ),
    "v3-r2d2": partial(
        make_training,
        name="v3",
        learner={"sampling": "steps", "stored_state": True, "priority_exponent": 0.9, "burn_in": 0.25, "slice_len": 4},
    ),
    "drqn-gymnasium": partial(make_training, name="drqn", worlds=cart_and_pole),
    "v3-minigrid": partial(make_training, name="v3", worlds=door_and_key),
    "v2-discovered": partial(
        make_training,
        name="v2",
        learner={"warmup_frames": BATCH},
        options={"subgoals": "discovered", "discovery": FINDING, "sub_hindsight": True},
    ),
    "v3-discovered": partial(
        make_training,
        name="v3",
        learner={"warmup_frames": BATCH},  # after a batch that memories forget
        options={"subgoals": "discovered", "discovery": FINDING},
    ),
}


@dataclass(frozen=True)
class Cut:
    """A stop request that arrives as a method is called."""

    method: Callable  # trainer -> owner and name of the method
    when: Callable  # trainer -> whether it is this call
    holds: Callable  # checks, on the stopped trainer, that the cut is what its name says

    def arm(self, trainer, action=partial(signal.raise_signal, signal.SIGTERM)):  # noqa: B008
        """Calls ``action`` once."""
        owner, name = self.method(trainer)
        method = getattr(owner, name)

        def cutting(*args, **kwargs):
            if self.when(trainer):
                setattr(owner, name, method)
                action()
            return method(*args, **kwargs)

        setattr(owner, name, cutting)


def level(trainer, number):
    """A learner; flat algorithms have only one."""
    learners = list(trainer.algorithm.learners.values())
    return learners[min(number, len(learners) - 1)]


def before_updates_of(batch, holds):
    return Cut(lambda trainer: (level(trainer, 1), "store"), lambda trainer: trainer.frames == batch * BATCH, holds)


def after_updates_of(batch, holds):
    def method(trainer):
        return trainer.collector, "update_policy_weights_"

    return Cut(method, lambda trainer: trainer.frames == batch * BATCH, holds)


def between_updates(number, updates, holds):
    def when(trainer):
        return level(trainer, number).updates == updates

    return Cut(lambda trainer: (level(trainer, number), "update"), when, holds)


def in_evaluation_after(batch, holds):
    return Cut(lambda trainer: (trainer, "evaluate"), lambda trainer: trainer.frames == batch * BATCH, holds)


def at(trainer, *, batch, rows, updates_each):
    """Counters of all parts."""
    assert (trainer.frames, trainer.logger.csv.rows) == (batch * BATCH, rows)
    assert {learner.updates for learner in trainer.algorithm.learners.values()} == set(updates_each)


def owed(trainer, *, number, dues):
    """Updates that remain in the iteration, and the minibatches already drawn for them."""
    left = tuple(learner.updates_due() for learner in trainer.algorithm.learners.values())
    assert left[:2] == (dues if len(left) > 1 else (dues[number],))
    assert level(trainer, number).state_dict()["drawn"]


def steps_in_episodes(env):
    """How many steps the episode in progress has, for each world."""
    if hasattr(env, "steps"):
        return env.steps
    return torch.tensor([len(moment["actions"]) for moment in env.worlds.vector.get_attr("moment")])


def options_in_progress(trainer):
    steps = steps_in_episodes(trainer.collector.env.base_env)
    assert ((steps > 0) & (steps < 7)).any()
    assert trainer.state_dict()["tracker"]["sums"]["steps"].tolist() == steps.tolist()
    if len(trainer.algorithm.learners) > 1:
        options = level(trainer, 1).extract.state_dict()
        assert options["is_open"].any() and len(options["held"])  # in progress; done, but their episode is not
        carrier = trainer.collector.state_dict()["carrier"]
        assert (carrier["option_steps"] > 0).any() and carrier["meta_hidden"].any()


def memories_wrapped(trainer):
    """Every replay memory is full and has wrapped around."""
    for learner in trainer.algorithm.learners.values():
        assert learner.buffer.is_full()
        assert 0 < learner.buffer.state_dict()["_writer"]["_cursor"] < len(learner.buffer.storage[:])


CUTS = {
    "in the first evaluation": in_evaluation_after(0, partial(at, batch=0, rows=0, updates_each=[0])),
    "during warm-up": after_updates_of(1, partial(at, batch=1, rows=1, updates_each=[0])),
    "before the first update": before_updates_of(3, partial(at, batch=3, rows=1, updates_each=[0])),
    "between two updates": between_updates(0, 1, partial(owed, number=0, dues=(2, 4))),
    "between two updates of the other level": between_updates(1, 6, partial(owed, number=1, dues=(0, 1))),
    "in an evaluation": in_evaluation_after(4, partial(at, batch=4, rows=2, updates_each=[8])),
    "in the middle of options": after_updates_of(5, options_in_progress),
    "behind a row of metrics": after_updates_of(6, partial(at, batch=6, rows=4, updates_each=[16])),
    "with full memories": after_updates_of(7, memories_wrapped),
    "in the last batch": before_updates_of(8, partial(at, batch=8, rows=4, updates_each=[20])),
}


FEW = ("between two updates", "in the middle of options", "with full memories")
PAIRS = [("v2", cut) for cut in CUTS]  # what they cut is the same code for all
PAIRS += [(training, cut) for training in ("drqn", "v1", "v2-odd", "v2-refreshed", "v2-hindsight", "v3") for cut in FEW]
PAIRS += [(training, "in an evaluation") for training in ("drqn", "v1")]
PAIRS += [(training, "in the middle of options") for training in ("v1-three-levels", "v2-three-levels")]
PAIRS += [("v2-phases", cut) for cut in ("in an evaluation", "behind a row of metrics", *FEW[1:])]
PAIRS += [(training, "between two updates") for training in TRAININGS if training.endswith(("r2d2", "whole", "levels"))]
PAIRS += [(training, "with full memories") for training in ("v2-whole", "v3-r2d2")]
PAIRS += [("v3-discovered", cut) for cut in ("during warm-up", *FEW)]
PAIRS += [("v2-discovered", "in the middle of options")]
PAIRS += [(training, "in the middle of options") for training in ("drqn-gymnasium", "v3-minigrid")]
OTHERS = [("v2-odd", "in the first evaluation"), ("v3-r2d2", "in the first evaluation")]
OTHERS += [("v1-r2d2", "with full memories")]
"""Where else the tests below begin."""


@pytest.fixture(scope="module")
def prepare(tmp_path_factory):
    """Trains once without stops and once with all that a test begins at."""

    @cache
    def prepare(name):
        build, folder = TRAININGS[name], tmp_path_factory.mktemp("training")
        seed_everything(0)
        build(folder / "uninterrupted").train()
        seed_everything(0)
        trainer = build(folder / "run")
        for each in [each for each in CUTS if (name, each) in PAIRS + OTHERS]:
            cut = CUTS[each]
            cut.arm(trainer)
            with pytest.raises(Interrupted):
                trainer.train()
            cut.holds(trainer)
            shutil.copytree(folder / "run", folder / each)
        trainer.train()
        return build, folder

    return prepare


@pytest.fixture
def training(request, prepare):
    """How to build a training, and folders: "uninterrupted", "run" (stopped at every cut), one as each cut left it."""
    return prepare(request.param)


def resume(build, folder, **settings):
    """A new training with other seeds that continues from the stopped one's newest checkpoint."""
    seed_everything(99)
    trainer = build(folder, seed=99, **settings)
    trainer.resume(trainer.checkpoints.newest())
    return trainer


@pytest.mark.parametrize(("training", "name"), PAIRS, indirect=["training"])
def test_a_stopped_and_resumed_training_equals_an_uninterrupted_one(training, name, tmp_path):
    build, folder = training
    shutil.copytree(folder / name, tmp_path, dirs_exist_ok=True)
    trainer = resume(build, tmp_path)
    Checkpoints(tmp_path / "again" / "checkpoints").save(trainer._parts(), step=trainer.frames)
    check_same_checkpoint(tmp_path / "again", folder / name)  # everything that was saved was restored
    trainer.train()
    check_same(tmp_path, folder / "uninterrupted")


only_v2 = pytest.mark.parametrize("training", ["v2"], indirect=True)


@only_v2
def test_a_training_resumed_in_the_same_process_equals_an_uninterrupted_one(training):
    _, folder = training
    check_same(folder / "run", folder / "uninterrupted")


@only_v2
def test_a_training_stopped_many_times_equals_an_uninterrupted_one(training, tmp_path):
    build, folder = training
    shutil.copytree(folder / "in the first evaluation", tmp_path, dirs_exist_ok=True)
    for name in ("between two updates", "between two updates of the other level", "with full memories"):
        trainer = resume(build, tmp_path)
        CUTS[name].arm(trainer)
        with pytest.raises(Interrupted):
            trainer.train()
    resume(build, tmp_path).train()
    check_same(tmp_path, folder / "uninterrupted")


def stop_after(trainer, moments):
    """Requests a stop at the given number of the trainer's checks, which come before updates and after iterations."""
    check = trainer._stop.check

    def counting():
        nonlocal moments
        moments -= 1
        if moments == 0:
            signal.raise_signal(signal.SIGTERM)
        check()

    trainer._stop.check = counting


@pytest.mark.parametrize("training", ["v2-odd", "v3-r2d2"], indirect=True)
@pytest.mark.parametrize("seed", [1, 2])
def test_a_training_stopped_at_random_moments_equals_an_uninterrupted_one(training, seed, tmp_path):
    build, folder = training
    generator, cuts, wrapped = random.Random(seed), 0, 0
    shutil.copytree(folder / "in the first evaluation", tmp_path, dirs_exist_ok=True)
    while True:
        trainer = resume(build, tmp_path)
        wrapped += all(learner.buffer.is_full() for learner in trainer.algorithm.learners.values())
        stop_after(trainer, generator.randint(1, 12))
        try:
            trainer.train()
        except Interrupted:
            cuts += 1
        else:
            break
    assert cuts >= 3 and wrapped >= 2
    check_same(tmp_path, folder / "uninterrupted")


@only_v2
def test_a_crashed_training_repeats_what_came_after_its_checkpoint(training, tmp_path):
    def crash():
        raise RuntimeError("crash")

    build, folder = training
    shutil.copytree(folder / "between two updates", tmp_path, dirs_exist_ok=True)
    trainer = resume(build, tmp_path, checkpoint_frames=160)
    CUTS["in the last batch"].arm(trainer, crash)
    with pytest.raises(RuntimeError, match="crash"):
        trainer.train()
    assert [row["frames"] for row in table(tmp_path)] == ["0", "96", "128", "192"]
    trainer = resume(build, tmp_path)
    assert trainer.frames == 160 and [row["frames"] for row in table(tmp_path)] == ["0", "96", "128"]
    trainer.train()
    check_same(tmp_path, folder / "uninterrupted")


@pytest.mark.parametrize("training", ["drqn", "v2"], indirect=True)
def test_a_finished_training_continues_when_total_frames_is_raised(training, tmp_path):
    build, folder = training
    shutil.copytree(folder / "between two updates", tmp_path, dirs_exist_ok=True)
    resume(build, tmp_path, total_frames=128).train()
    trainer = resume(build, tmp_path)
    at(trainer, batch=4, rows=3, updates_each=[8])
    trainer.train()
    check_same(tmp_path, folder / "uninterrupted")


@only_v2
def test_resuming_a_finished_training_changes_nothing(training, tmp_path):
    build, folder = training
    shutil.copytree(folder / "uninterrupted", tmp_path, dirs_exist_ok=True)
    resume(build, tmp_path).train()
    check_same(tmp_path, folder / "uninterrupted")


@pytest.mark.parametrize("training", ["v1-r2d2", "v2", "v3"], indirect=True)
def test_a_checkpoint_without_memories_resumes_with_empty_ones(training, tmp_path):
    """Networks, optimisers, counters and worlds are restored; updates wait for the warm-up and are not made up for."""
    build, folder = training
    shutil.copytree(folder / "with full memories", tmp_path, dirs_exist_ok=True)
    trainer = resume(build, tmp_path, checkpoints=Checkpoints(tmp_path / "checkpoints", replay=False))
    frames, updates, expected = trainer.frames, trainer.updates, trainer.algorithm.policy.state_dict()
    expected = {key: value.clone() for key, value in expected.items()}
    trainer._saving._saved = ()
    trainer.save()
    trainer = resume(build, tmp_path, total_frames=frames + 160)
    assert "holds no replay memory: it begins empty and is warmed up again" in trainer.logger.console.file.getvalue()
    assert (trainer.frames, trainer.updates) == (frames, updates)
    assert all((value == expected[key]).all() for key, value in trainer.algorithm.policy.state_dict().items())
    made = {name: learner.updates for name, learner in trainer.algorithm.learners.items()}
    for learner in trainer.algorithm.learners.values():
        assert not len(learner.buffer) and not learner.updates_due()
        assert learner.schedule.frames_owed == pytest.approx(-64, abs=8)  # warmup_frames
    trainer.train()
    for name, learner in trainer.algorithm.learners.items():
        assert 0 < learner.updates - made[name] <= (160 - 64) / 8 + 1
