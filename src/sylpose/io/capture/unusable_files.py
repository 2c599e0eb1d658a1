"""Why files in a recording's folder are no videos, and what to do with them."""

from __future__ import annotations

from pathlib import Path

# Remedies by the suffixes of files that cannot be used as they are.
_RAW = "raw streams have no times: put each into a container (ffmpeg -r RATE -i FILE -c copy FILE.mkv)"
_ARCHIVE = "unpack it first"
_BAG = "export the images, one folder for each camera, with their times in the names"
_VENDOR = "convert it to a video or to images with its maker's program"
REMEDIES = {
    **dict.fromkeys((".h264", ".264", ".h265", ".265", ".hevc", ".mjpeg", ".mjpg", ".m2v", ".yuv"), _RAW),
    **dict.fromkeys((".zip", ".7z", ".rar", ".tar", ".gz", ".tgz", ".bz2", ".xz"), _ARCHIVE),
    **dict.fromkeys((".bag", ".db3", ".mcap", ".svo", ".svo2"), _BAG),
    **dict.fromkeys((".cine", ".seq", ".raw", ".mraw", ".r3d", ".braw", ".ser", ".xvid", ".insv", ".360"), _VENDOR),
    **dict.fromkeys((".gif", ".heic", ".dng", ".cr2", ".nef", ".arw"), "convert it to a video or to PNG images"),
    **dict.fromkeys((".part", ".crdownload", ".partial", ".tmp"), "its download or copy is not complete"),
}
# Files are listed up to this number (choice).
MAX_LISTED = 4


def describe_unusable_files(folder: Path) -> str:
    """Return a sentence on the files of a folder that hold pictures in a form that is not read; "" without any."""
    by_remedy = dict[str, list[str]]()
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in REMEDIES and path.name[0] != "." and path.is_file():
            by_remedy.setdefault(REMEDIES[path.suffix.lower()], []).append(path.name)
    return "; ".join(
        f"{', '.join(names[:MAX_LISTED])}{', ...' if len(names) > MAX_LISTED else ''}: {remedy}"
        for remedy, names in by_remedy.items()
    )


def describe_unusable_video(path: Path) -> str:
    """Return why a file cannot be opened as a video, if that is known; "" else."""
    size = path.stat().st_size
    if not size:
        return "the file is empty: nothing was recorded, or its copy failed"
    boxes = _list_boxes(path, size)
    if {b"ftyp", b"mdat", b"wide", b"free"} & set(boxes[:1]) and b"moov" not in boxes:
        return (
            "its index, moov, is missing: the recording was interrupted or the copy is not complete; programs such as "
            "untrunc restore it with the help of a complete video of the same camera"
        )
    return ""


def _list_boxes(path: Path, size: int) -> list[bytes]:
    """Return the types of the outer boxes of an MP4 or QuickTime file; of any other file, a few meaningless ones."""
    boxes, at = list[bytes](), 0
    with path.open("rb") as file:
        while at + 8 <= size and len(boxes) < 100:
            file.seek(at)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            if length == 1:
                length = int.from_bytes(head[8:16], "big")
            boxes.append(head[4:8])
            at += length if length >= 8 else size
    return boxes
