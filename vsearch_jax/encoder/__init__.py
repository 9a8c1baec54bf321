"""The encoder: network, domain randomisation, training as an augmented autoencoder (thesis 3.3) or on known poses."""

from vsearch_jax.encoder.augment import augment_input, clean_target, draw_shade, jitter_camera, randomize_lights
from vsearch_jax.encoder.fit import fit_whitening, init, update
from vsearch_jax.encoder.network import code_of, encode, network_input, raw_latent, reconstruct
from vsearch_jax.encoder.pose_loss import match_metrics, view_angles

__all__ = [
    "augment_input",
    "clean_target",
    "code_of",
    "draw_shade",
    "encode",
    "fit_whitening",
    "init",
    "jitter_camera",
    "match_metrics",
    "network_input",
    "randomize_lights",
    "raw_latent",
    "reconstruct",
    "update",
    "view_angles",
]
