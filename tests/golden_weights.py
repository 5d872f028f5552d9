"""Conversion of the recorded networks (see tests/golden/README.md) to networks and parameters of this package."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxswarm import AGGREGATORS, ActorCritic
from jaxswarm.types import Entities, Observation

GOLDEN = Path(__file__).parent / "golden"
ACTIVATIONS = {"LeakyReLU": "leaky_relu", "ReLU": "relu", "Tanh": "tanh"}
PRIOR = {"one_per_dim": "feature", True: "scalar", False: None}


def cases(name):
    """Yield the recorded cases of a file: the meta data, and the arrays by name."""
    archive = np.load(GOLDEN / name)
    for meta in json.loads(str(archive["meta_json"]))["cases"]:
        prefix = f"c{meta['case']:03d}_"
        yield meta, {key.removeprefix(prefix): archive[key] for key in archive.files if key.startswith(prefix)}


def aggregator(meta):
    options = meta["agg_mode"]
    if options["type"] == "Mean":
        return AGGREGATORS[options["actual_mode"]]()
    if options["type"] == "MultiHeadAttention":
        return AGGREGATORS["attentive"](num_heads=options["num_heads"], residual=options["residual"])
    return AGGREGATORS["bayesian"](
        prior_mean=PRIOR[options["learnable_mu_z_0"]],
        prior_variance=PRIOR[options["learnable_sigma_z_0"]],
        rectifier="softplus" if options["variance_rectifier"] == "softplus" else "exp",
        output_variance=options["output_variance"],
    )


def network(meta):
    return ActorCritic(
        encoder=(*meta["embedding_hidden"], meta["embedding_dim"]),
        decoder=(*meta["out_hidden"], meta["latent_dim"]),
        activation=ACTIVATIONS[meta["activation"]],
        aggregator=aggregator(meta),
        latent_space={"same": "shared", "separate": "separate"}[meta["agg_into_space"]],
    )


def observation(meta, flat):
    """Split the flat observation; the original networks ignored the valid flag, so every row is present."""
    layout = meta["layout"]
    own, groups, start = None, {}, 0
    for part in layout["order"]:
        if part == "local":
            own = flat[..., start : start + layout["n_local"]]
            start += layout["n_local"]
            continue
        for group in layout["sets"]:
            size = group["rows"] * group["width"]
            rows = flat[..., start : start + size].reshape(*flat.shape[:-1], group["rows"], group["width"])
            start += size
            features = rows[..., :-1] if group["valid_last"] else rows
            groups[group["name"]] = Entities(jnp.asarray(features), jnp.ones(rows.shape[:-1], bool))
    assert start == flat.shape[-1]
    return Observation(jnp.asarray(own), groups)


def params(meta, weights):
    """Return the parameters of `network(meta)`; recorded matrices are (out, in), with interleaved Bayesian parts."""

    def dense(name):
        return {"kernel": jnp.asarray(weights[f"{name}.weight"].T), "bias": jnp.asarray(weights[f"{name}.bias"])}

    def encoder(prefix):
        depth = len(meta["embedding_hidden"])
        layers = {f"Dense_{i}": dense(f"{prefix}.{2 * i}") for i in range(depth)}
        last = dense(f"{prefix}.{2 * depth}")
        if meta["agg_mode"]["type"] == "Bayesian":
            last = jax.tree.map(lambda x: jnp.concatenate([x[..., ::2], x[..., 1::2]], -1), last)
        return layers | last

    width = meta["embedding_dim"] * (2 if meta["agg_mode"].get("output_variance") else 1)

    def pooling(prefix):
        priors = {"prior_mean": "mean_z_0", "prior_variance": "sigma_z_0_sq"}
        mha = {"in_kernel": "attention.mha.in_proj_weight", "in_bias": "attention.mha.in_proj_bias"}
        mha |= {"out_kernel": "attention.mha.out_proj.weight", "out_bias": "attention.mha.out_proj.bias"}
        recorded_names = {name: f"{prefix}.{recorded}" for name, recorded in (priors | mha).items()}
        found = {name: jnp.asarray(weights[key]) for name, key in recorded_names.items() if key in weights}
        return {name: x.T if name in mha else x.reshape(-1) for name, x in found.items()}

    names = [group["name"] for group in meta["layout"]["sets"]]

    def in_alphabetical_order(kernel):
        """Reorder rows from [own, aggregates in the recorded order] to [own, aggregates in alphabetical order]."""
        if meta["agg_into_space"] == "same":
            return kernel
        own, *aggregates = jnp.split(kernel, meta["layout"]["n_local"] + width * np.arange(len(names)))
        return jnp.concatenate([own, *(aggregates[names.index(name)] for name in sorted(names))])

    def tower(kind):
        prefix = f"mlp_extractor.{'shared' if meta['shared_vf_pi'] else kind}_network"
        result = {f"Dense_{i}": dense(f"{prefix}.later_layer.{2 * i}") for i in range(len(meta["out_hidden"]) + 1)}
        result["Dense_0"]["kernel"] = in_alphabetical_order(result["Dense_0"]["kernel"])
        for name in names:
            result[f"{name}_encoder"] = encoder(f"{prefix}.embedders.{name}.embedding.nn")
            result[f"{name}_aggregator"] = pooling(f"{prefix}.aggregators.{name}")
        result["groups_aggregator"] = pooling(f"{prefix}.aggregator")
        return {name: value for name, value in result.items() if value}

    tree = {"actor": tower("pi"), "critic": tower("vf"), "log_std": jnp.asarray(weights["log_std"])}
    return {"params": tree | {"action_mean": dense("action_net"), "value_head": dense("value_net")}}


def weights(arrays, prefix):
    return {name.removeprefix(prefix): x for name, x in arrays.items() if name.startswith(prefix)}
