"""Strict JAX for every test: shapes checked at run time, rank promotion an error."""

import jax
import jaxtyping

jaxtyping.install_import_hook("jaxswarm", "beartype.beartype")

jax.config.update("jax_numpy_rank_promotion", "raise")
