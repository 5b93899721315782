"""From a raw window to a forecast: the same call in training, evaluation and serving."""

from dataclasses import asdict, dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.decoder import Decoder
from models.encoder import Encoder, differences
from models.latent import Latent
from models.normalize import Normalizer, Placement
from models.skeleton import KINECT_V1
from models.spec import MotionSpec


@dataclass(frozen=True, slots=True)
class NetConfig:
    """Sizes of the net; written into every checkpoint."""

    encoder_hidden: int = 192
    encoder_heads: int = 4
    continuous: int = 192
    categories: int = 27
    decoder_token: int = 64
    decoder_hidden: int = 128
    decoder_heads: int = 4
    spl_hidden: int = 32
    dropout: float = 0.0
    canonical_heading: bool = True


@dataclass(frozen=True, slots=True)
class Encoded:
    """What the decoder gets: the latent, the seed pose and where it all stands."""

    z: Float[Tensor, "batch continuous"]
    c: Float[Tensor, "batch category"]
    seed: Float[Tensor, "batch joint 3"]
    placement: Placement


class Predictor(nn.Module):
    """The whole net. Windows and forecasts are absolute metres, y up, in the Kinect v1 order."""

    def __init__(self, spec: MotionSpec | None = None, config: NetConfig | None = None) -> None:
        super().__init__()
        self.spec = spec or MotionSpec()
        self.config = config or NetConfig()
        size = self.config
        self.normalizer = Normalizer(self.spec.joints, canonical_heading=size.canonical_heading)
        self.encoder = Encoder(
            self.spec.joints,
            hidden=size.encoder_hidden,
            heads=size.encoder_heads,
            dropout=size.dropout,
        )
        self.latent = Latent(
            self.encoder.width, continuous=size.continuous, categories=size.categories
        )
        self.decoder = Decoder(
            KINECT_V1.parents,
            continuous=size.continuous,
            categories=size.categories,
            token=size.decoder_token,
            hidden=size.decoder_hidden,
            spl_hidden=size.spl_hidden,
            heads=size.decoder_heads,
            dropout=size.dropout,
        )

    def forward(
        self, window: Float[Tensor, "batch observe joint 3"], *, horizon: int | None = None
    ) -> Float[Tensor, "batch horizon joint 3"]:
        """Forecast the next frames of each window, in the frame of the input.

        Args:
            window: observed poses in metres, any float type, y up, right-handed.
            horizon: frames to forecast; the spec's (15) unless told.

        Raises:
            ValueError: the window has not the spec's number of frames or joints.
        """
        return self.decode(self.encode(window), window, horizon=horizon)

    def encode(self, window: Float[Tensor, "batch observe joint 3"]) -> Encoded:
        """Run the shared part: normalisation, encoder and latent of the last observed frame."""
        if window.shape[1:3] != (self.spec.observe, self.spec.joints):
            raise ValueError(
                f"a window has {self.spec.observe} frames of {self.spec.joints} joints, "
                f"got {tuple(window.shape[1:])}"
            )
        placement = self.normalizer.place(window)
        position = self.normalizer.to_net(window, placement)
        velocity, acceleration = differences(position, self.normalizer.scales)
        z, c = self.latent(self.encoder(position, velocity, acceleration))
        return Encoded(z, c, position[:, -1], placement)

    def decode(
        self,
        encoded: Encoded,
        window: Float[Tensor, "batch observe joint 3"],
        *,
        horizon: int | None = None,
    ) -> Float[Tensor, "batch horizon joint 3"]:
        """Run the personal part: roll the decoder out and put the poses back into the room."""
        steps = self.spec.horizon if horizon is None else horizon
        displacement = self.decoder(encoded.z, encoded.c, encoded.seed, horizon=steps)
        return self.normalizer.from_net(displacement, window, encoded.placement)

    def describe(self) -> dict[str, object]:
        """Sizes and parameter counts, for metadata and logs."""
        parts = {"encoder": self.encoder, "latent": self.latent, "decoder": self.decoder}
        counts = {name: sum(p.numel() for p in part.parameters()) for name, part in parts.items()}
        return {"spec": asdict(self.spec), "config": asdict(self.config), "parameters": counts}


@torch.no_grad()
def forecast_in_batches(
    forecaster: nn.Module, windows: Float[Tensor, "windows observe joint 3"], *, batch: int = 512
) -> Float[Tensor, "windows horizon joint 3"]:
    """Forecast many windows without holding all of the intermediate results at once."""
    forecaster.eval()
    return torch.cat([forecaster(part) for part in windows.split(batch)])
