"""uavctl: stochastic predictive flight control over links that lose packets."""

__version__ = "0.2.0"
