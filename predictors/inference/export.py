"""The command `asp-env export`; importing it needs neither torch nor onnx."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from asp_env.console import text_console
from asp_env.errors import AspEnvError, MissingExtraError


@dataclass(frozen=True, slots=True, kw_only=True)
class Export:
    """Write a trained predictor as an ONNX file, which runs without this package."""

    predictor: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PREDICTOR:RUN")]
    """A trained predictor with its folder, such as ssp-asp:runs/1 or ssp-asp:runs/1@top1."""
    out: Path
    """The file to write; it must not exist."""
    features: bool = False
    """Add the network's features of each target to the outputs."""

    def run(self) -> None:
        """Exports the predictor, compares the file with the network, and writes it.

        Raises:
            AspEnvError: The predictor cannot be loaded or is not trained, or the file exists.
        """
        if self.out.exists():
            raise AspEnvError(f"{self.out} exists: give another --out, or delete it")
        if not self.out.parent.is_dir():
            raise AspEnvError(f"{self.out.parent} is no folder: make it, or give another --out")
        try:
            from predictors.inference.onnx_file import write_onnx
        except ModuleNotFoundError as error:
            raise MissingExtraError(str(error.name), "export", "export to ONNX") from error

        difference = write_onnx(self.predictor, self.out, features=self.features)
        text_console().print(
            f"wrote {self.out}: differs from the network by at most {difference:.0e} on random "
            "inputs",
            soft_wrap=True,
        )
