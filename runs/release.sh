#!/usr/bin/env bash
# Train the families `world` and `streets` from random weights, and put them into the package:
#   runs/release.sh KITTI OUT
# KITTI is a data set in SemanticKITTI's layout with camera_labels/ and the splits train, val and labelled. Every stage
# resumes: run the same command again after an interruption, in slices as short as a machine allows. Seeds are those of
# the recipes.
#   FORM=        the recipes' full size, for a GPU (default -mini: two CPU cores)
#   MINUTES=1.5  each stage takes so many times as long (default 1)
#   TOWNS=1000   how many towns are simulated (default 60, at least 15)
#   PHOTOGRAPHS= splits with images that teach the painter of `streets`: "train,FOLDER:split,..." (default train)
#   PLACES=      splits with scans of other places and sensors that teach segmenter and translator of `streets`; a scan
#                without labels of its own needs a labelled image (default: none)
#   CLEAN=       splits with scans and images that teach `world`, of licences that allow any use (default: none)
# TOWNS=15 MINUTES=0.004 rehearses all of it (two hours beside other work on two cores) and ends with useless families:
# in a clone, since those in the package are replaced.
# For a GPU machine without a network: `runs/pack.py pack KITTI FILE` here, `runs/pack.py unpack FILE KITTI` there.
# The weights of version 0.1.0 were not made by this script but stage by stage, by earlier scripts that are in the history
# up to b3e012f: with networks pruned, averaged and finished between stages.
set -euo pipefail
kitti=$1 out=$2
form=${FORM--mini} longer=${MINUTES:-1} towns=${TOWNS:-60}
here=$(dirname "$0")
weights() { echo "$out/$1/weights/$2.safetensors"; }
stage() { # RUN RECIPE DATA MINUTES [OVERRIDE...]
  local run=$1 recipe=$2 data=$3 minutes set=()
  minutes=$(python -c "print($4 * $longer)")
  shift 4
  for override in "$@"; do set+=(--set "$override"); done
  lidar2pano train "$recipe$form" --data "$data" --out "$out/$run" --set "training.minutes=$minutes" "${set[@]}"
}
world() { # NAME [OPTION...]: a simulated data set below OUT
  lidar2pano world "$out/towns/$1" "${@:2}"
}
family() { # NAME SEGMENTER TRANSLATOR PAINTER DATA SPLIT LICENCE
  mkdir -p "$out/$1"
  cp "$2" "$out/$1/segmenter.safetensors"
  cp "$3" "$out/$1/translator.safetensors"
  cp "$4" "$out/$1/painter.safetensors"
  lidar2pano evaluate "$out/$1" --data "$5" --split "$6" --json "$out/$1.json"
  python "$here/release_family.py" "$out/$1" "$1" "$out/$1.json" --licence "$7"
}

# A painter learns from photographs, and from towns in their own looks what no camera sees: an autoencoder, then mean and
# flow of its latents, then texture, then a smaller encoder. runs/stages/ says what made the released ones.
latents() { # NAME DATA PHOTOGRAPHS SEGMENTER TRANSLATOR
  local set=(data.train="$3,$day:all,$pictures" training.validate_minutes=0)
  stage "$1-pictures" autoencoder "$2" 70 "${set[@]}" options.perceptual=0 options.adversarial=0
  stage "$1-latents" latent-painter "$2" 240 "${set[@]}" options.segmenter="$4" options.translator="$5" \
    options.autoencoder="$(weights "$1-pictures" autoencoder)"
}
painter() { # NAME DATA PHOTOGRAPHS SEGMENTER TRANSLATOR RUN-OF-THE-START
  local set=(data.train="$3,$day:all,$pictures" training.validate_minutes=0)
  stage "$1-texture" latent-texture "$2" 95 "${set[@]}" options.segmenter="$4" options.translator="$5" \
    networks.painter.start="$(weights "$6" painter)"
  stage "$1-painter" latent-encoder "$2" 25 "${set[@]}" options.painter="$(weights "$1-texture" painter)"
}

# Towns. Scans alone are cheap; pictures all around cost four seconds a frame on two cores. Nothing learns from `test`.
world scans --sequences "$towns" --frames 12 --hz 1.5 --seed 1 --save scans
world centre-scans --place centre --sequences "$towns" --frames 12 --hz 1 --seed 12201 --save scans
for sensor in pandar64 os1-128 hdl32e vlp16; do
  world "$sensor-scans" --sensor "$sensor" --sequences $((towns / 12)) --frames 12 --hz 1.5 --seed 5300 --save scans
done
world day --sequences $((towns / 5)) --frames 4 --hz 1.5 --seed 101
world centre --place centre --sequences $((towns / 5)) --frames 3 --hz 0.7 --seed 12101
world pandar64-day --sensor pandar64 --sequences $((towns / 15)) --frames 3 --hz 0.7 --seed 14201
world pandar64-centre --sensor pandar64 --place centre --sequences $((towns / 10)) --frames 4 --hz 1 --seed 33001
world os1-128-day --sensor os1-128 --sequences $((towns / 10)) --frames 1 --hz 1 --seed 44001
for look in overcast autumn evening; do
  world "$look" --sequences $((towns / 15)) --frames 3 --hz 1.5 --seed 202 --look "$look"
done
# As high as any sensor sees: of translators for taller panoramas.
for sensor in os1-128 pandar64 hdl64e; do
  world "tall-$sensor" --sensor "$sensor" --sequences $((towns / 10)) --frames 2 --hz 0.7 --seed 61001 --view panorama-tall/2
done
world tall-centre --sensor os1-128 --place centre --sequences $((towns / 10)) --frames 2 --hz 0.7 --seed 61101 \
  --view panorama-tall/2
world test --sequences 5 --frames 4 --hz 10 --seed 909
day=$out/towns/day
sensors=$(printf "$out/towns/%s-scans:all," pandar64 os1-128 hdl32e vlp16)
looks=$(printf "$out/towns/%s:all," overcast autumn evening centre pandar64-day pandar64-centre os1-128-day)
tall=$(printf "$out/towns/%s:all," tall-os1-128 tall-pandar64 tall-hdl64e tall-centre)
scans=$out/towns/centre-scans:all,${sensors%,} pictures=${looks%,}

# Taller rows come last, and half of the weights stay: the usual rows are read oftener.
taller() { # RUN RECIPE DATA SPLITS SEGMENTER RUN-OF-THE-START [OVERRIDE...]
  stage "$1" "$2" "$3" 9 view=panorama-tall data.train="$tall$tall$4" training.validate_minutes=0 \
    options.segmenter="$5" options.remission_octaves=3 networks.translator.optimizer.rate=5e-4 \
    networks.translator.start="$(weights "$6" translator)" networks.translator.start_share=0.5 "${@:7}"
}

# Segmenters go on with scans of other places and sensors, above an HDL-64E's beams too, at any level of remission, mixed,
# and of sensors that stand higher, lower or lean: more steps alone made them worse elsewhere (docs/guides/train.md).
any_direction=(options.rotation_deg=180 options.augment_probability=0.4 training.validate_minutes=0)
further() { # RUN DATA SPLITS SEGMENTER SHARE: of its weights stays so much
  stage "$1" fast-segmenter "$2" 38 data.train="$3" "${any_direction[@]}" options.remission_octaves=3 \
    options.tallest=hdl64e-tall options.fixed_norms=true options.mix_probability=0.5 options.place_probability=0.4 \
    training.batch=2 training.accumulate=2 networks.segmenter.optimizer.rate=1e-3 \
    networks.segmenter.start="$4" networks.segmenter.start_share="$5"
}

# Family `world`: simulated data, and CLEAN. A segmenter is taught by one with twice the arithmetic.
clean=${CLEAN:+,$CLEAN}
stage world-wide release-segmenter "$out/towns/scans" 90 data.train="all,$scans" "${any_direction[@]}"
stage world-narrow fast-segmenter "$out/towns/scans" 45 data.train="all,$scans" "${any_direction[@]}" \
  options.teacher="$(weights world-wide segmenter)"
further world-segmenter "$out/towns/scans" "all,$scans$clean" "$(weights world-narrow segmenter)" 0.25
stage world-translator release-translator "$day" 75 data.train="all,$pictures$clean" training.validate_minutes=0 \
  options.segmenter="$(weights world-segmenter segmenter)" options.remission_octaves=3
taller world-tall release-translator "$day" "$pictures$clean" "$(weights world-segmenter segmenter)" world-translator
networks=("$(weights world-segmenter segmenter)" "$(weights world-tall translator)")
latents world "$day" "${CLEAN:-all}" "${networks[@]}"
painter world "$day" "${CLEAN:-all}" "${networks[@]}" world-latents
family world "${networks[@]}" \
  "$(weights world-painter painter)" "$out/towns/test" all Apache-2.0

# Family `streets`: real frames beside towns, from the networks of `world`; segmenter and translator are taught by wide ones.
often=$(printf 'train,%.0s' {1..6})$(printf 'labelled,%.0s' {1..8})
real=train,train,train,"$day:all,$pictures"
stage wide-segmenter release-segmenter "$kitti" 60 data.train="$often$scans" "${any_direction[@]}" \
  networks.segmenter.start="$(weights world-wide segmenter)"
stage segmenter fast-segmenter "$kitti" 45 data.train="$often$scans" "${any_direction[@]}" \
  options.teacher="$(weights wide-segmenter segmenter)" networks.segmenter.start="$(weights world-segmenter segmenter)"
labels=options.segmenter="$(weights segmenter segmenter)"
stage wide-translator release-translator "$kitti" 75 data.train="$real" training.validate_minutes=0 "$labels" \
  networks.translator.start="$(weights world-tall translator)"
stage translator fast-translator "$kitti" 90 data.train="$real" training.validate_minutes=0 "$labels" \
  options.teacher="$(weights wide-translator translator)" options.elsewhere_probability=0.35
others=${PLACES:+,$PLACES}
further further-segmenter "$kitti" "$often$scans$others" "$(weights segmenter segmenter)" 0.5
# The translator keeps half of its weights, too, and so half of the margin that finds more buildings on new streets.
stage further-translator fast-translator "$kitti" 30 data.train="train,train,$real$others" training.validate_minutes=0 \
  options.segmenter="$(weights further-segmenter segmenter)" options.remission_octaves=5 options.building_margin=1.0 \
  networks.translator.optimizer.rate=7e-4 \
  networks.translator.start="$(weights translator translator)" networks.translator.start_share=0.5
taller streets-tall fast-translator "$kitti" "train,$pictures${PLACES:+,$PLACES}" \
  "$(weights further-segmenter segmenter)" further-translator options.remission_octaves=5 options.building_margin=0.5
streets=("$(weights further-segmenter segmenter)" "$(weights streets-tall translator)")
latents streets "$kitti" "${PHOTOGRAPHS:-train}" "${streets[@]}"
painter streets "$kitti" "${PHOTOGRAPHS:-train}" "${streets[@]}" streets-latents
family streets "${streets[@]}" "$(weights streets-painter painter)" \
  "$kitti" val CC-BY-NC-SA-4.0
