"""Names that are refused, and files that are not looked at."""

from __future__ import annotations

from collections import Counter

from v2v_protocol.programs import printable

_NO_VIDEO_SUFFIXES = frozenset({
    ".7z", ".aac", ".ac3", ".aedat", ".aedat4", ".ass", ".bag", ".bib", ".bin", ".bmp", ".bz2", ".c", ".cfg", ".conf",
    ".cpp", ".csv", ".dat", ".db", ".doc", ".docx", ".exr", ".flac", ".gz", ".h", ".h5", ".hdf5", ".htm", ".html",
    ".info", ".ini", ".ipynb", ".jpeg", ".jpg", ".json", ".jsonl", ".log", ".lst", ".m4a", ".mat", ".md", ".md5",
    ".mp3", ".nfo", ".npy", ".npz", ".ogg", ".opus", ".parquet", ".pdf", ".pickle", ".pkl", ".png", ".pt", ".pth",
    ".py", ".raw", ".rst", ".sh", ".sha256", ".sqlite3", ".srt", ".sub", ".tar", ".tgz", ".thm", ".tif", ".tiff",
    ".tmp", ".toml", ".tsv", ".txt", ".vtt", ".wav", ".webp", ".xlsx", ".xml", ".xz", ".yaml", ".yml", ".zip", ".zst",
})  # fmt: skip
_MOST_SUFFIXES_SHOWN = 10

UNPRINTABLE = "its name is not UTF-8 text, or holds control characters; rename it"


def count_left_out(name: str, left_out: Counter[str]) -> None:
    """Count a file that may be a video of another ending."""
    stem, _, ending = name.rpartition(".")
    suffix = printable(f".{ending.lower()}")
    if stem and len(suffix) <= 12 and suffix not in _NO_VIDEO_SUFFIXES:
        left_out[suffix] += 1


def left_out_note(left_out: Counter[str]) -> str:
    """Return the line that reports files with other endings; "" where there is no such file."""
    if not left_out:
        return ""
    shown = ", ".join(f"{suffix} ({count})" for suffix, count in sorted(left_out.items())[:_MOST_SUFFIXES_SHOWN])
    more = len(left_out) - _MOST_SUFFIXES_SHOWN
    return (
        f"{left_out.total()} files have endings that are not looked at and were left out: {shown}"
        f"{f' and {more} other endings' if more > 0 else ''}. Name those that are videos in a list file to serve them"
    )
