"""Keys and values that version 0.1 or other libraries name differently."""

from collections.abc import Callable
from typing import Any

KEYS = {  # by the name in version 0.1
    "num_worlds": "num_envs",
    "eval_worlds": "num_eval_envs",
    "desynchronised_start": "desynchronized_start",
    "learner.max_gradient_norm": "learner.max_grad_norm",
    "learner.coefficient": "learner.regression_coefficient",
    "learner.minibatch": "learner.sampling_unit",
}
VALUES = {("learner.sampling_unit", "worlds"): "envs", ("task.relative_velocity", "normalised"): "normalized"}

OF_OTHER_LIBRARIES = {  # by the name in Stable-Baselines3, CleanRL, JaxMARL, rejax, RLlib or Gymnasium, in lower case
    "lr": "learner.learning_rate",
    "actor_lr": "learner.learning_rate",
    "gamma": "learner.discount",
    "discount_factor": "learner.discount",
    "lam": "learner.gae_lambda",
    "lambda": "learner.gae_lambda",
    "lambda_": "learner.gae_lambda",
    "clip_eps": "learner.clip_range",
    "clip_coef": "learner.clip_range",
    "clip_param": "learner.clip_range",
    "clip_ratio": "learner.clip_range",
    "ent_coef": "learner.entropy_coefficient",
    "entropy_coeff": "learner.entropy_coefficient",
    "vf_coef": "learner.value_coefficient",
    "value_coef": "learner.value_coefficient",
    "vf_loss_coeff": "learner.value_coefficient",
    "grad_clip": "learner.max_grad_norm",
    "n_epochs": "learner.num_epochs",
    "epochs": "learner.num_epochs",
    "update_epochs": "learner.num_epochs",
    "minibatch_size": "learner.batch_size",
    "num_minibatches": "learner.batch_size",
    "n_envs": "num_envs",
    "num_env_runners": "num_envs",
    "n_steps": "num_steps",
    "rollout_length": "num_steps",
    "rollout_fragment_length": "num_steps",
    "total_timesteps": "total_agent_steps",
    "timesteps": "total_agent_steps",
    "num_timesteps": "total_agent_steps",
    "eval_freq": "eval_every",
    "n_eval_episodes": "num_eval_envs",
    "n_agents": "task.num_agents",
    "max_episode_steps": "task.episode_length",
    "max_steps": "task.episode_length",
    "env": "task",
    "env_id": "task",
    "env_name": "task",
    "algo": "learner",
    "hidden_size": "network.encoder",
    "hidden_sizes": "network.encoder",
    "net_arch": "network.encoder",
}


def key_of_other_library(key: str) -> str | None:
    """Return our name of a key that another library uses, with or without a prefix; `None` for other keys."""
    return OF_OTHER_LIBRARIES.get(key.rpartition(".")[2].lower())


def current_key(key: str) -> str | None:
    """Return the present name of a key of version 0.1, with a prefix if `key` has one; `None` for other keys."""
    without_prefix = {old.rpartition(".")[2]: new.rpartition(".")[2] for old, new in KEYS.items()}
    return KEYS.get(key) or without_prefix.get(key)


def current_value(key: str, value: Any) -> str | None:
    """Return the present name of a value of version 0.1 under the present key; `None` for other values."""
    return VALUES.get((key, value)) if isinstance(value, str) else None


def translate_override(text: str) -> str:
    """Return an override of version 0.1, such as `num_worlds=2,4`, with the present names."""
    key, equals, value = text.partition("=")
    key = current_key(key) or key
    full = {new.rpartition(".")[2]: new for new, _ in VALUES}.get(key, key)
    values = [current_value(full, x) or x for x in value.split(",")]
    return f"{key}{equals}{','.join(values)}"


def translate_space(space: dict[str, Any], is_key: Callable[[str], bool]) -> tuple[dict[str, Any], list[str]]:
    """Return the search space with present names, and one text "old -> new" for each name of version 0.1 in it.

    `is_key(key)` says whether a key of version 0.1 is a key of the searched config, so that it must not be translated.
    """
    result, changes = {}, []
    for old, choice in space.items():
        key = old if is_key(old) else current_key(old) or old
        full = KEYS.get(old, key)
        values = [current_value(full, x) or x for x in choice] if isinstance(choice, list) else choice
        if (key, values) != (old, choice):
            changes.append(f"{old} -> {key}" if key != old else f"values of {key}")
        result[key] = values
    return result, changes


def translate(config: dict[str, Any], has_field: Callable[[str, str], bool]) -> tuple[dict[str, Any], list[str]]:
    """Return the config with present names, and one text "old -> new" for each name of version 0.1 in it.

    `has_field(part, name)` says whether a key of version 0.1 is a field of the part, such as a user's learner, so that
    it must not be translated.
    """
    changes: list[str] = []

    def translated(fields: dict[str, Any], part: str) -> dict[str, Any]:
        prefix = f"{part}." if part else ""
        result = {}
        for name, value in fields.items():
            key = old = f"{prefix}{name}"
            if old in KEYS and not (part and has_field(part, name)):
                key = KEYS[old]
            new_value = current_value(key, value)
            if new_value is not None:
                changes.append(f"{old}={value} -> {key}={new_value}")
            elif key != old:
                changes.append(f"{old} -> {key}")
            result[key.removeprefix(prefix)] = value if new_value is None else new_value
        return result

    parts = {name: translated(x, name) if isinstance(x, dict) else x for name, x in config.items()}
    return translated(parts, ""), changes
