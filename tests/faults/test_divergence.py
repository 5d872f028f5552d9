"""The state before an update that diverges is saved, and replaying that update shows what became non-finite first."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxswarm
from jaxswarm import config as configs
from jaxswarm.host.fit import DivergedError, fit
from jaxswarm.tasks import Rendezvous
from jaxswarm.types import pytree, static

OVERRIDES = (
    "task.num_agents=3 task.episode_length=5 num_envs=2 num_steps=4 learner.batch_size=12 num_eval_envs=2 "
    "eval_every=50 network.encoder=[4] network.decoder=[4]"
)
EXPERIMENT = configs.build(configs.compose(OVERRIDES.split()))


@pytree
class Broken(Rendezvous):
    """Rendezvous whose reward or observation is NaN in the last step of an episode."""

    part: str = static(default="reward")

    def step(self, key, state, action):
        state, step = super().step(key, state, action)
        is_broken = (self.part == "reward") & (state.time == self.episode_length - 1)
        return state, step.replace(reward=jnp.where(is_broken, jnp.nan, step.reward))

    def observe(self, state):
        obs = super().observe(state)
        is_broken = (self.part == "observation") & (state.time == self.episode_length - 1)
        return obs.replace(own=jnp.where(is_broken, jnp.nan, obs.own))


def diverge(experiment, run_dir, capsys, num_updates=20):
    with pytest.raises(DivergedError):
        fit(experiment, num_updates, seed=3, run_dir=run_dir, progress=True)
    printed = capsys.readouterr()
    return printed.out + printed.err


@pytest.mark.slow
def test_a_learning_rate_that_is_too_high(tmp_path, capsys):
    experiment = EXPERIMENT.replace(learner=EXPERIMENT.learner.replace(learning_rate=1e10))
    text = diverge(experiment, tmp_path / "run", capsys)
    (folder,) = (tmp_path / "run" / "diverged").iterdir()
    assert folder.name == "seed3"
    found = re.search(r"""non-finite first: (\w+); .*python -c "(.*)"$""", text, flags=re.M)
    assert found[1] in ("loss", "gradient", "parameter")
    exec(found[2])
    assert capsys.readouterr().out.strip() == found[1]
    replay = jaxswarm.replay_update(folder)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((replay.state.learner.params, replay.trajectory.reward)))
    assert replay.metrics["is_finite"] == 0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* gets no config")
@pytest.mark.parametrize("part", ["reward", "observation"])
def test_a_task_with_numbers_that_are_not_finite(part, tmp_path, capsys):
    broken = Broken(num_agents=3, episode_length=5, part=part)
    experiment = EXPERIMENT.replace(task=broken, eval_every=50, desynchronized_start=True)
    text = diverge(experiment, tmp_path / "run", capsys, 4)
    if "diverged and is frozen: eval/return" not in text:
        assert f"non-finite first: {part}" in text
    replay = jaxswarm.replay_update(tmp_path / "run" / "diverged" / "seed3", experiment)
    assert replay.first == part
