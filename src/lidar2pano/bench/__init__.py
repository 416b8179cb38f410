"""Times of this machine, and tensor operations."""

from lidar2pano.bench.operations import measure_operations, operations_table
from lidar2pano.bench.timings import (
    compare,
    comparison_table,
    conditions,
    default_weights,
    measure,
    measure_world,
    table,
    untrained,
)

__all__ = [
    "compare",
    "comparison_table",
    "conditions",
    "default_weights",
    "measure",
    "measure_operations",
    "measure_world",
    "operations_table",
    "table",
    "untrained",
]
