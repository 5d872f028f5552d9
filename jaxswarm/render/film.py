"""An episode of a policy as a film: the scenes, the score, and what agents look at."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxswarm.scene import Scene
from jaxswarm.types import Key

MAX_SHARES = 4_000_000  # numbers in the shares of a film; what is left of 10 MB once a page holds them as text

# Okabe and Ito's colors, which the colour-blind can tell apart
GROUPS = ("#e69f00", "#009e73", "#cc79a7", "#56b4e9")
LIGHT: dict[str, Any] = {"agents": "#0072b2", "evaders": "#d55e00", "caught": "#009e73", "groups": GROUPS}
LIGHT |= {"films": ("#0072b2", "#d55e00", "#009e73", "#cc79a7")}
DARK: dict[str, Any] = {"agents": "#56b4e9", "films": ("#56b4e9", "#e69f00", "#009e73", "#cc79a7")}  # where it differs


@dataclasses.dataclass(frozen=True)
class Film:
    """One episode, played with the mean action, to its end. The first frame is the state before the first step."""

    title: str
    scenes: Scene  # of NumPy arrays, [frames, ...]
    score: Float[np.ndarray, " frames"]  # sum of the rewards so far
    shares: Float[np.ndarray, "kept agents bodies"] | None  # of a body in what an agent aggregates; NaN: not perceived
    shares_every: int  # frames from one of the shares to the next

    @property
    def num_frames(self) -> int:
        """Steps that were taken, and one."""
        return len(self.score)

    @property
    def low(self) -> Float[np.ndarray, "2"]:
        """The lower left corner of the world."""
        return self.scenes.low[0]

    @property
    def high(self) -> Float[np.ndarray, "2"]:
        """The upper right corner of the world."""
        return self.scenes.high[0]

    @property
    def catches(self) -> list[tuple[int, Float[np.ndarray, "2"]]]:
        """Frames in which evaders are caught, and where."""
        is_caught, evaders = self.scenes.is_caught, self.scenes.evaders
        if is_caught is None or evaders is None:
            return []
        return [(int(frame), evaders.position[frame, i]) for frame, i in np.argwhere(is_caught)]

    @property
    def trail(self) -> int:
        """Length of trails: frames in which a typical agent goes an eighth of the side, from 10 to 60."""
        side = float(self.high[0] - self.low[0])
        stride = np.linalg.norm(np.diff(self.scenes.agents.position, axis=0), axis=-1)
        moving = stride[(stride > 1e-4 * side) & (stride < side / 2)]  # the others stand, or crossed a seam
        return int(np.clip(side / 8 / np.median(moving), 10, 60)) if moving.size else 10


def record(
    task: Any, network: Any, params: Any, *, seed: int = 0, title: str = "", max_shares: int = MAX_SHARES
) -> Film:
    """Plays one episode.

    Shares take a number for each agent and body. Of swarms where that exceeds `max_shares` numbers in all frames they
    are kept of every k-th frame, with the smallest k that is enough, and of swarms where two frames exceed it, of none.
    """
    num_frames = task.episode_length + 1
    size = task.num_agents * jax.eval_shape(lambda key: task.scene(task.reset(key)), jax.random.key(0)).num_bodies
    kept = min(max_shares // size, num_frames)
    every = -(-num_frames // kept) if kept >= 2 else num_frames
    key = jax.random.key(seed)
    scenes, rewards, is_over, shares = jax.device_get(_play(key, task, network, params, every, kept >= 2))
    end = int(np.argmax(is_over)) + 2 if is_over[: num_frames - 1].any() else num_frames
    score = np.concatenate([[0.0], np.cumsum(rewards[: end - 1], dtype=np.float64)])
    scenes = jax.tree.map(lambda x: x[:end], scenes)
    return Film(title, scenes, score, None if shares is None else shares[: -(-end // every)], every)


@functools.partial(jax.jit, static_argnames=("network", "every", "is_weighed"))
def _play(
    key: Key, task: Any, network: Any, params: Any, every: int, is_weighed: bool
) -> tuple[Scene, Array, Array, Array | None]:
    """Scenes before each step, rewards and ends, all of at least one step more than an episode has; and the shares."""
    reset_key, step_key = jax.random.split(key)
    num_pieces = -(-(task.episode_length + 1) // every)

    def step(state: Any, key: Key) -> tuple:
        action = network.apply(params, task.observe(state), method="policy").mean()
        after, outcome = task.step(key, state, jnp.clip(action, -1.0, 1.0))
        return after, (task.scene(state), outcome.reward, outcome.terminated | outcome.truncated)

    def piece(state: Any, keys: Key) -> tuple:
        shares = _shares(task, network, params, state) if is_weighed else None
        state, frames = jax.lax.scan(step, state, keys)
        return state, (frames, shares)

    keys = jax.random.split(step_key, (num_pieces, every))
    _, (frames, shares) = jax.lax.scan(piece, task.reset(reset_key), keys)
    scenes, rewards, is_over = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), frames)
    return scenes, rewards, is_over, shares


def _shares(task: Any, network: Any, params: Any, state: Any) -> Float[Array, "agents bodies"]:
    """The weights of all groups, by the number of the body in the scene."""
    obs, slots, num_bodies = task.observe(state), task.slots(state), task.scene(state).num_bodies
    shares = jnp.full((task.num_agents, num_bodies), jnp.nan)
    agent = jnp.arange(task.num_agents)[:, None]
    for name, weights in network.apply(params, obs, method="weights").items():
        body = jnp.where(obs.groups[name].mask, slots[name], num_bodies)  # the others are dropped
        shares = shares.at[agent, body].set(weights, mode="drop")
    return shares
