"""The command `asp-env bench`: speed of rasters, simulation, environments and predictors."""

from asp_env.evaluation.bench.bench import Bench
from asp_env.evaluation.bench.timing import Latency, Rate, measure_latencies

__all__ = ["Bench", "Latency", "Rate", "measure_latencies"]
