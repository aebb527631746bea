"""Which snippets are learnt from, selected on and judged on, and how a checkpoint says so."""

from typing import Any, Literal

import numpy as np
from jaxtyping import Shaped

from asp_env.data.clock import frames_per_tick
from asp_env.data.snippets import SnippetIndex
from asp_env.data.source import Recordings
from asp_env.data.split import NUM_BLOCKS, split_blocks, split_by_recording

Split = Literal["recording", "blocks"]

SPLIT_SEED = 42


def snippet_parts(
    recordings: Recordings, snippets: SnippetIndex, split: Split
) -> tuple[Shaped[np.ndarray, " n"], dict[str, Any]]:
    """The part of each snippet, and the words of a checkpoint's provenance for it.

    Args:
        recordings: those that the snippets were found in.
        snippets: all of them.
        split: by recording, or by blocks of time within each.

    Returns:
        (n,) strings `train`, `validation`, `test` or `none`; and a dict ready for JSON with the
        content hash and part of each recording, from which the split can be told again.

    Raises:
        AspEnvError: no recording is left to test on.
    """
    if split == "recording":
        counts = np.bincount(snippets.recording, minlength=len(recordings))
        locations = [recording.location for recording in recordings]
        of_recording = split_by_recording(counts, locations, seed=SPLIT_SEED)
        parts = np.array(of_recording, dtype="<U10")[snippets.recording]
    else:
        lengths = [
            (each.num_frames - 1) // frames_per_tick(each.frame_rate_hz, snippets.dt_s) + 1
            for each in recordings
        ]
        of_recording = ("blocks",) * len(recordings)
        parts = split_blocks(
            snippets.recording,
            snippets.tick - snippets.history,
            snippets.tick + snippets.horizon,
            lengths=np.array(lengths, dtype=np.int64),
            seed=SPLIT_SEED,
        )
    described = {
        "split": split,
        "split_seed": SPLIT_SEED,
        "num_blocks": NUM_BLOCKS if split == "blocks" else None,
        "recordings": [
            {"name": name, "hash": content, "part": part}
            for name, content, part in zip(
                recordings.names, recordings.hashes(), of_recording, strict=True
            )
        ],
    }
    return parts, described
