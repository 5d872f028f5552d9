"""Aggregators that map the messages of a group of any size, in any order, to one vector of fixed size.

An aggregator is a linen module that is called with a list of messages and their `Segments`, and returns the vector of
each receiver. Most are commutative monoids (see `sets`), so they can be computed without holding all messages in memory
at once. `Attentive` and `Concat` need the whole group and have `pool` instead.

To inspect a trained policy, `weights` returns the share of each entity in the vector of its group. The shares of
present entities sum to 1; absent entities have exactly 0.

A message has `num_parts` parts of equal length. With `num_encoders=1` one encoder computes all parts; with as many
encoders as parts each computes one part; with `num_encoders=0` the message is the features of an entity, not encoded.
"""

from jaxswarm.aggregators.attentive import Attentive
from jaxswarm.aggregators.features import Concat, Histogram, RadialBasis
from jaxswarm.aggregators.monoids import Bayesian, Max, Mean, Softmax
from jaxswarm.registry import Registry

AGGREGATORS = Registry(
    "aggregator",
    {
        "mean": Mean,
        "max": Max,
        "softmax": Softmax,
        "bayesian": Bayesian,
        "attentive": Attentive,
        "concat": Concat,
        "histogram": Histogram,
        "rbf": RadialBasis,
    },
)

__all__ = ["AGGREGATORS", "Attentive", "Bayesian", "Concat", "Histogram", "Max", "Mean", "RadialBasis", "Softmax"]
