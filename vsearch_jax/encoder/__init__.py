"""The augmented autoencoder (thesis 3.3): network, domain randomisation, training."""

from vsearch_jax.encoder.augment import augment_input, clean_target, jitter_camera, randomize_lights
from vsearch_jax.encoder.fit import fit_whitening, init, update
from vsearch_jax.encoder.network import code_of, encode, network_input, raw_latent, reconstruct

__all__ = [
    "augment_input",
    "clean_target",
    "code_of",
    "encode",
    "fit_whitening",
    "init",
    "jitter_camera",
    "network_input",
    "randomize_lights",
    "raw_latent",
    "reconstruct",
    "update",
]
