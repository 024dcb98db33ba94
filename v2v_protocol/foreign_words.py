"""Words of sister commands, of other event-camera tools and of PyTorch, and what they are called here."""

from __future__ import annotations

from collections.abc import Mapping

_NO_FLAG = "give the input without a flag"
_DEVICE = "samples are made on processor cores; a training chooses it, v2v-train --set compute.device=cuda"
_BATCH = (
    "the consumer chooses it: V2VStreamDataset(..., batch_size=N), DataLoader(V2VDataset(...), batch_size=N), "
    "v2v-train --set stream.batch_size=N"
)
_SERVER = "a server has workers: v2v-serve --workers N, V2VStreamDataset.local(..., workers=N)"
_MEANT = {
    # flags of sister commands
    "port listen": ("bind", "connect", "page"),
    "host address server url": ("connect", "bind"),
    "seed": ("seeds", "the consumer chooses it: V2VStreamDataset(..., seed=N), v2v-train --set stream.seed=N"),
    "epoch": ("the consumer chooses it: V2VStreamDataset(..., epoch=N)",),
    "batch_size batch": (_BATCH,),
    "arrays": ("the consumer chooses them: V2VStreamDataset(..., arrays=...)",),
    "device gpu cuda": (_DEVICE,),
    "lr learning_rate": ("learning_rate", "v2v-train --set optimizer.learning_rate=X"),
    "epochs num_epochs": ("v2v-train --set run.epochs=N",),
    "steps": ("v2v-train --set run.steps=N",),
    "checkpoint": ("resume", "weights"),
    "videos_kind": ("flags",),
    # inputs and outputs, also of v2e and of OpenEB
    "input i input_path input_file path": ("videos", "data", _NO_FLAG),
    "data dataset data_dir root root_dir folder": ("videos", "data"),
    "output o output_folder output_path output_file output_dir": ("out",),
    "dvs_h5 dvs_aedat2 dvs_aedat4 dvs_text": ("events", "out"),
    # cameras of v2e, ESIM and OpenEB
    "threshold_pos threshold_neg": ("threshold",),
    "threshold pos_thres cp positive_threshold contrast_threshold_positive": ("threshold", "threshold_pos"),
    "neg_thres cn negative_threshold contrast_threshold_negative": ("threshold", "threshold_neg"),
    "contrast_threshold contrast_thresholds": ("threshold", "threshold_pos"),
    "sigma_thres contrast_threshold_sigma sigma_threshold": ("threshold_mismatch_sigma",),
    "cutoff_hz": ("photoreceptor_hz",),
    "leak_rate_hz": ("leak_hz",),
    "shot_noise_rate_hz": ("shot_noise_hz",),
    "refractory_period refractory_period_s refractory_period_ns": ("refractory_seconds",),
    "dvs_exposure": ("voxel_seconds",),
    "output_width width": ("crop_width_px",),
    "output_height height": ("crop_height_px",),
    "num_bins n_bins num_time_bins time_bins": ("bins",),
    # Python and PyTorch
    "num_workers n_workers": ("workers", "DataLoader(dataset, ..., num_workers=N)"),
    "workers jobs j threads processes nproc": ("workers", _SERVER),
    "videos": ("data", "V2VStreamDataset.local(videos) starts a server for them"),
    "transform transforms": ("apply it to the batch",),
    "drop_last": ("all batches are whole",),
    "pin_memory": ("DataLoader(..., pin_memory=True)",),
    "collate_fn": ("batches are whole: DataLoader(dataset, batch_size=None)",),
}
FOREIGN: Mapping[str, tuple[str, ...]] = {word: meant for words, meant in _MEANT.items() for word in words.split()}
"""By word, in the form of a key: keys that may be meant, the likeliest first, and in the end an explanation."""
