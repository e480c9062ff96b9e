"""The networks: from an RGB image and zero-shot images to maps."""

from zerobev.models.base import BevModel, MapLogits
from zerobev.models.tim import TIM
from zerobev.models.two_streams import TwoStreamZeroBEV
from zerobev.models.variants import VARIANTS, build, load_model
from zerobev.models.vpn import VPN
from zerobev.models.zero_bev import ZeroBEV

__all__ = [
    "TIM",
    "VARIANTS",
    "VPN",
    "BevModel",
    "MapLogits",
    "TwoStreamZeroBEV",
    "ZeroBEV",
    "build",
    "load_model",
]
