"""Make tests/golden: the recorded tensors of the published networks and operators, sampled.

    python runs/compact_golden.py GOLDEN OUT

GOLDEN is the folder of whole recordings, OUT the folder to write (created; tests/golden in the repository). A tensor of
more than 2,000 elements (5,000 for projections) is kept at that many positions, drawn by the rule of
tests/support/golden_vectors.py from the names of file and tensor, so that the positions are not stored. Inputs that the
fill rule makes again are left out. Tables of keys, statistics of layers and the recorded training steps are copied as
far as tests read them. The same GOLDEN gives the same bytes.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "support"))

from golden_vectors import facts, positions  # pyright: ignore[reportMissingImports]

SAMPLES = 2_000  # per tensor of a network
OPERATOR_SAMPLES = 5_000  # per tensor of a projection
WHOLE = {"ioueval", "knn_synth"}  # files whose integer tensors are inputs or are counted exactly
COPIED = ("*.keys.txt", "*.taps.json", "labels.json")
UNREAD = {"titan_g_2048.taps.json"}
# KITTI's licence forbids these, and the labels of the recorded training step follow from the fill rule.
LEFT_OUT = {"projection_salsa_kitti", "projection_titan_kitti", "titan_trainstep_labels_B2"}
STEP_FIELDS = {  # of titan_trainstep.json
    *("gp", "wdistance", "lovasz_guiding", "g_loss_reported", "after_step"),
    *("D_grad_l2", "D_step_delta_l2", "G_grad_l2", "G_step_delta_l2"),
}
STEPS = ("B1_gpweight1_fp32", "B1_gpweight10_fp32", "B2_gpweight1_fp32", "B2_gpweight10_fp32")


def main() -> None:
    """Read the arguments and write the folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("golden", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    write(arguments.golden, arguments.out)
    print(f"{arguments.out}: {sum(path.stat().st_size for path in arguments.out.iterdir()):,} bytes")


def write(golden: Path, out: Path) -> None:
    """Write the compact form of the folder `golden` into the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    for path in sorted(golden.glob("*.safetensors")):
        if path.stem not in LEFT_OUT:
            tensors, metadata = compact(path)
            save_file(tensors, out / path.name, metadata)
    for path in sorted({path for pattern in COPIED for path in golden.glob(pattern)}):
        if path.name not in UNREAD:
            shutil.copyfile(path, out / path.name)
    steps = json.loads((golden / "titan_trainstep.json").read_text())
    kept = {step: {field: steps[step][field] for field in steps[step].keys() & STEP_FIELDS} for step in STEPS}
    (out / "titan_trainstep.json").write_text(json.dumps(kept, indent=1, sort_keys=True) + "\n")


def compact(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The sampled tensors of a file, and its metadata in one entry, so that their order is fixed."""
    tensors: dict[str, Tensor] = {}
    sampled: dict[str, Any] = {}
    samples = OPERATOR_SAMPLES if path.stem.startswith("projection") else SAMPLES
    with safe_open(path, "pt") as stored:
        for name in sorted(stored.keys()):
            tensor = stored.get_tensor(name)
            if name.startswith("in."):
                continue
            if tensor.numel() > samples and path.stem not in WHOLE:
                sampled[name] = {"shape": list(tensor.shape), "samples": samples}
                tensor = tensor.flatten()[positions(path.stem, name, sampled[name])]
            tensors[name] = tensor.contiguous()
    said = facts(path.parent, path.stem) | {"sampled": sampled}
    return tensors, {"facts": json.dumps(said, sort_keys=True)}


if __name__ == "__main__":
    main()
