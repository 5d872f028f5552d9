"""Films: recorded episodes of a policy, with scenes, returns and aggregation weights."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxswarm import rollout
from jaxswarm.scene import Scene
from jaxswarm.types import Key

MAX_SHARES = 4_000_000  # largest number of weights in a film, so that its page stays below 10 MB

# Okabe and Ito's palette, which color-blind readers can distinguish
GROUPS = ("#e69f00", "#009e73", "#cc79a7", "#56b4e9")
LIGHT: dict[str, Any] = {"agents": "#0072b2", "evaders": "#d55e00", "caught": "#009e73", "groups": GROUPS}
LIGHT |= {"films": ("#0072b2", "#d55e00", "#009e73", "#cc79a7")}
DARK: dict[str, Any] = {
    "agents": "#56b4e9",
    "films": ("#56b4e9", "#e69f00", "#009e73", "#cc79a7"),
}  # differences from LIGHT


@dataclasses.dataclass(frozen=True)
class Film:
    """One complete episode with the mean action. The first frame is the state before the first step."""

    title: str
    scenes: Scene  # NumPy arrays, [frames, ...]
    score: Float[np.ndarray, " frames"]  # undiscounted return up to each frame
    shares: Float[np.ndarray, "kept agents bodies"] | None  # weight of a body in an agent's aggregate; NaN: unseen
    shares_every: int  # number of frames between two recorded shares

    @property
    def num_frames(self) -> int:
        """Number of frames, one more than the number of steps."""
        return len(self.score)

    @property
    def low(self) -> Float[np.ndarray, "2"]:
        """Lower left corner of the world, in world units."""
        return self.scenes.low[0]

    @property
    def high(self) -> Float[np.ndarray, "2"]:
        """Upper right corner of the world, in world units."""
        return self.scenes.high[0]

    @property
    def catches(self) -> list[tuple[int, Float[np.ndarray, "2"]]]:
        """Frame and position of each catch of an evader."""
        is_caught, evaders = self.scenes.is_caught, self.scenes.evaders
        if is_caught is None or evaders is None:
            return []
        return [(int(frame), evaders.position[frame, i]) for frame, i in np.argwhere(is_caught)]

    @property
    def trail(self) -> int:
        """Length of trails in frames, from 10 to 60, in which the median agent moves an eighth of the side."""
        side = float(self.high[0] - self.low[0])
        stride = np.linalg.norm(np.diff(self.scenes.agents.position, axis=0), axis=-1)
        moving = stride[(stride > 1e-4 * side) & (stride < side / 2)]  # without agents that stand or cross a seam
        return int(np.clip(side / 8 / np.median(moving), 10, 60)) if moving.size else 10


def record(
    task: Any, network: Any, params: Any, *, seed: int = 0, title: str = "", max_shares: int = MAX_SHARES
) -> Film:
    """Record one episode of a policy.

    Each recorded frame has one weight (share) per agent and body. If the weights of all frames exceed `max_shares`
    numbers, only every k-th frame has them, with the smallest sufficient k. If two frames exceed it, no frame has them.
    """
    num_frames = task.episode_length + 1
    size = task.num_agents * jax.eval_shape(lambda key: task.scene(task.reset(key)), jax.random.key(0)).num_bodies
    num_kept = min(max_shares // size, num_frames)
    has_shares = num_kept >= 2
    every = -(-num_frames // num_kept) if has_shares else num_frames
    key = jax.random.key(seed)
    scenes, rewards, is_over, shares = jax.device_get(_play(key, task, network, params, every, has_shares))
    end = int(np.argmax(is_over)) + 2 if is_over[: num_frames - 1].any() else num_frames
    score = np.concatenate([[0.0], np.cumsum(rewards[: end - 1], dtype=np.float64)])
    scenes = jax.tree.map(lambda x: x[:end], scenes)
    return Film(title, scenes, score, None if shares is None else shares[: -(-end // every)], every)


@functools.partial(jax.jit, static_argnames=("network", "every", "has_shares"))
def _play(
    key: Key, task: Any, network: Any, params: Any, every: int, has_shares: bool
) -> tuple[Scene, Array, Array, Array | None]:
    """Return the scenes before each step, the rewards, the ends of episodes and, every `every` steps, the shares.

    The arrays cover at least one step more than an episode.
    """
    reset_key, step_key = jax.random.split(key)
    num_chunks = -(-(task.episode_length + 1) // every)

    policy = functools.partial(network.apply, params, method="policy")

    def first_env(tree: Any) -> Any:
        return jax.tree.map(lambda x: x[0], tree)

    def step(states: Any, key: Key) -> tuple:
        interaction = rollout.interact(key, task, policy, states, rollout.mean_action)
        frame = first_env((jax.vmap(task.scene)(states), interaction.outcome.reward, interaction.is_done))
        return interaction.state, frame

    def chunk(states: Any, keys: Key) -> tuple:
        shares = _shares(task, network, params, first_env(states)) if has_shares else None
        states, frames = jax.lax.scan(step, states, keys)
        return states, (frames, shares)

    keys = jax.random.split(step_key, (num_chunks, every))
    _, (frames, shares) = jax.lax.scan(chunk, jax.vmap(task.reset)(reset_key[None]), keys)
    scenes, rewards, is_over = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), frames)
    return scenes, rewards, is_over, shares


def _shares(task: Any, network: Any, params: Any, state: Any) -> Float[Array, "agents bodies"]:
    """Return the weights of all groups, by the number of the body in the scene; NaN for bodies without a weight."""
    obs, slots, num_bodies = task.observe(state), task.slots(state), task.scene(state).num_bodies
    shares = jnp.full((task.num_agents, num_bodies), jnp.nan)
    agent = jnp.arange(task.num_agents)[:, None]
    for name, weights in network.apply(params, obs, method="weights").items():
        body = jnp.where(obs.groups[name].mask, slots[name], num_bodies)  # out of bounds, so that masked slots drop out
        shares = shares.at[agent, body].set(weights, mode="drop")
    return shares
