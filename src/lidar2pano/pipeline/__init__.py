"""Scan in, panorama out: the pipelines, and their assembly from weight files."""

from lidar2pano.pipeline.assembly import (
    card_view,
    engine_parts,
    load_painter,
    load_part,
    load_segmenter,
    load_translator,
    made_fast,
)
from lidar2pano.pipeline.segmenter import Segmenter
from lidar2pano.pipeline.stages import PaperPipeline, Pipeline, assemble, load

__all__ = [
    "PaperPipeline",
    "Pipeline",
    "Segmenter",
    "assemble",
    "card_view",
    "engine_parts",
    "load",
    "load_painter",
    "load_part",
    "load_segmenter",
    "load_translator",
    "made_fast",
]
