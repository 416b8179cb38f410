"""A bulk run with the stand-in pipeline on two Ray workers: python bulk_on_ray.py ROOT OUT."""

from __future__ import annotations

import sys
from functools import partial

from bulk_runs import WHOLE, job_of, run
from lidar2pano.bulk.on_ray import connected, translate_on_ray
from stand_in_pipeline import StandIn

if __name__ == "__main__":
    with connected("auto"):
        translate = partial(translate_on_ray, workers=2, cores=1, gpus=0)
        sys.exit(run(job_of(sys.argv[1], sys.argv[2], pipeline=StandIn(seconds=0.1)), WHOLE, translate))
