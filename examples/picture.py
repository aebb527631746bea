"""Draw a scene of the sample for people, beside the raster that a network sees."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from asp_env import ReplayEnv
from asp_env.data import load_predictor
from asp_env.render import draw_frame

ROAD, AGENTS, TRAIL, EGO = (150, 150, 150), (235, 120, 60), (250, 220, 90), (80, 200, 120)


def main(out: Path = Path("docs/scene.png"), *, scenario: int = 16, steps: int = 6) -> Path:
    """Drives some steps with zero actions, then draws the scene, a forecast and the raster."""
    env = ReplayEnv(observations=("raster",))
    observation, _ = env.reset(seed=0, options={"scenario": scenario})
    for _ in range(steps):
        observation, *_ = env.step(np.zeros(2, dtype=np.float32))
    scene = env.scene()
    forecast = load_predictor("constant-turn-rate", horizon=15, dt_s=scene.dt_s).predict(scene)
    background = env.recordings[env.scenarios[scenario].recording].background
    frame = draw_frame(scene, forecast=forecast, background=background)
    raster = cv2.resize(
        colour(observation["raster"]),
        (frame.shape[0] * 2 // 3, frame.shape[0]),
        interpolation=cv2.INTER_NEAREST,
    )
    picture = np.concatenate([frame, raster], axis=1)
    if not cv2.imwrite(str(out), picture[..., ::-1]):
        raise OSError(f"{out} cannot be written")
    return out


def colour(raster: UInt8[np.ndarray, "12 h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Draws the twelve channels as one picture, with darker boxes for earlier ticks."""
    picture = np.full((*raster.shape[1:], 3), 20, dtype=np.uint8)
    picture[raster[0] > 0] = ROAD
    for number, channel in enumerate(raster[3:], start=1):
        picture[channel > 0] = np.array(AGENTS) * number // 9
    picture[raster[2] > 0] = TRAIL
    picture[raster[1] > 0] = EGO
    return picture


if __name__ == "__main__":
    main()
