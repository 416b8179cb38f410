#!/usr/bin/env bash
# A look of the family `world` from KITTI's images alone, and what it changes on `val`:
#   runs/look_from_images.sh KITTI_MINI SCANS OUT [MINUTES]
# KITTI_MINI is a data set in SemanticKITTI's layout with camera_labels/, of which the images of `train` and their labels
# are taken, without scans; SCANS is any data set with scans, such as a simulated world. Writes OUT/look.md.
set -euo pipefail
kitti=$(realpath "$1") scans=$2 out=$3 minutes=${4:-15}
mkdir -p "$out/images/images/train" "$out/images/labels/train"
python - "$kitti" "$out/images" <<'PY'
import json
import shutil
import sys
from pathlib import Path

kitti, out = map(Path, sys.argv[1:])
for name in json.loads((kitti / "splits.json").read_text())["train"]:
    sequence, stem = name.split("/")
    labels = kitti / "sequences" / sequence / "camera_labels" / f"{stem}.png"
    for image in (kitti / "sequences" / sequence / "image_2").glob(f"{stem}.*"):
        shutil.copy(image, out / "images" / "train" / f"{sequence}-{image.name}")
        shutil.copy(labels, out / "labels" / "train" / f"{sequence}-{stem}.png")
PY
lidar2pano train scene-look-mini --data "$out/images" --out "$out/look" --set data.train=train,"$scans":all \
  --set options.weights=world --set options.look=kitti --set options.field_of_view_deg=81.4 \
  --set training.minutes="$minutes" --set options.cache="$out/scenes"
lidar2pano evaluate world "world+$out/look" --data "$kitti" --split val --metrics pictures,camera > "$out/look.md"
