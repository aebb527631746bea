"""Images and videos for people. The rasters that networks see are drawn by `asp_env.views`."""

from asp_env.render.film import Film, check_video_possible, frames_of, write_video
from asp_env.render.frames import FrameContents, draw_frame
from asp_env.render.live import LiveRenderer
from asp_env.render.window import PlayerState, Window, play

__all__ = [
    "Film",
    "FrameContents",
    "LiveRenderer",
    "PlayerState",
    "Window",
    "check_video_possible",
    "draw_frame",
    "frames_of",
    "play",
    "write_video",
]
