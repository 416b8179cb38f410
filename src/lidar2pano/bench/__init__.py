"""Times of this machine, and tensor operations."""

from lidar2pano.bench.engine_comparison import compare, comparison_table
from lidar2pano.bench.operations import measure_operations, operations_table
from lidar2pano.bench.timings import conditions, default_weights, measure, table, untrained
from lidar2pano.bench.world import measure_world

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
