"""Small untrained camera teachers of `transformers`, saved to a folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from lidar2pano.labels import CITYSCAPES
from lidar2pano.models.camera_teachers import MODEL_TYPES

transformers = pytest.importorskip("transformers")

MEAN, DEVIATION = [0.5, 0.4, 0.3], [0.2, 0.3, 0.25]
NAMES = ("ego-vehicle", *reversed(CITYSCAPES.classes))  # another order than ours, and a class more
TEXT = "the task is semantic"


def settings(**more: Any) -> dict[str, Any]:
    stages = ["stage1", "stage2", "stage3", "stage4"]
    swin = {"embed_dim": 8, "depths": [1] * 4, "num_heads": [1, 1, 2, 2], "window_size": 4, "out_features": stages}
    small = {"num_queries": 12, "hidden_dim": 32, "num_attention_heads": 2, "encoder_feedforward_dim": 16}
    names = dict(enumerate(NAMES))
    backbone = transformers.SwinConfig(**swin)
    layers = {"dim_feedforward": 16, "encoder_layers": 1, "decoder_layers": 2}
    return {"backbone_config": backbone, "id2label": names, "label2id": {v: k for k, v in names.items()}} | (
        small | layers | more
    )


def write_model(folder: Path, family: str, **more: Any) -> Path:
    """A small untrained model with settings of its image processor and, for OneFormer, a tokenizer."""
    torch.manual_seed(3)
    if family == "mask2former":
        config = transformers.Mask2FormerConfig(feature_size=32, mask_feature_size=32, **settings(**more))
    else:
        text = {"text_encoder_width": 64, "text_encoder_num_layers": 1, "text_encoder_vocab_size": 60}
        sizes = {"conv_dim": 32, "mask_dim": 32, "query_dec_layers": 1, "task_seq_len": 24}
        config = transformers.OneFormerConfig(**settings(**text, **sizes, **more))
        letters = sorted(set(TEXT.replace(" ", "")))
        vocabulary = ["<|startoftext|>", "<|endoftext|>", *letters, *(f"{letter}</w>" for letter in letters)]
        tokens = {token: number for number, token in enumerate(vocabulary, 5)}
        transformers.CLIPTokenizer(vocab=tokens, merges=[]).save_pretrained(folder)
    network = getattr(transformers, MODEL_TYPES[family])(config)
    for parameter in network.parameters():  # fresh networks answer the same everywhere
        if parameter.ndim > 1:
            torch.nn.init.normal_(parameter, std=3 * (parameter.shape[0] / parameter.numel()) ** 0.5)
    network.save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps({"image_mean": MEAN, "image_std": DEVIATION}))
    return folder
