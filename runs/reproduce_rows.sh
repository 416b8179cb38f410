#!/usr/bin/env bash
# Rows of the paper's tables in their small forms, each network trained for as many steps; writes docs/PAGE.md:
#   runs/reproduce_rows.sh DATA TABLES STEPS ROWS PAGE
# Training resumes: repeat the command. TITAN-Net and its ablations are compiled (a C++ compiler is needed): twice as many
# steps a minute. Point labels are those of the family world.
set -euo pipefail
data=$1 tables=$2 steps=$3 rows=$4 page=$5
cd "$(dirname "$0")/.."
changes=(--set vid2vid.training.minutes=5 --set pix2pix-segments.training.validate_minutes=0)
for part in titan titan-no-lovasz titan-no-range titan-no-segments; do
  changes+=(--set "$part.training.compile=true" --set "$part.training.validate_minutes=0")
done
lidar2pano reproduce --data "$data" --out "$tables" --form mini --budget "${steps}steps" --rows "$rows" \
  --segmenter world "${changes[@]}"
python runs/reproduce_docs.py "$tables" "$page"
