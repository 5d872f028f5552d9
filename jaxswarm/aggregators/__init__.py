"""Aggregators: the messages of a group of any size, in any order, become one vector of fixed size.

An aggregator is a linen module that is called with a list of messages and their `Segments`, and gives the vector of
each receiver. Most are commutative monoids (see `sets`), which is why they can also be computed without ever holding
all messages at once; `Attentive` and `Concat` need the whole group and have `pool` instead.

Each tells by `weights` which share each entity has in the vector of its group, for those who look at a trained policy:
shares of present entities sum to 1, absent ones have exactly 0.

A message has `num_parts` parts of equal length. `num_encoders` says what makes them: one encoder all parts, as many
encoders one part each, or, if 0, the message is the features of an entity as they are.
"""

from typing import Any

from jaxswarm.aggregators.attentive import Attentive
from jaxswarm.aggregators.features import Concat, Histogram, RadialBasis
from jaxswarm.aggregators.monoids import Bayesian, Max, Mean, Softmax

AGGREGATORS: dict[str, Any] = {
    "mean": Mean,
    "max": Max,
    "softmax": Softmax,
    "bayesian": Bayesian,
    "attentive": Attentive,
    "concat": Concat,
    "histogram": Histogram,
    "rbf": RadialBasis,
}

__all__ = ["AGGREGATORS", "Attentive", "Bayesian", "Concat", "Histogram", "Max", "Mean", "RadialBasis", "Softmax"]
