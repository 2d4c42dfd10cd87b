"""Deployment bundles: ONNX export, post-training quantization, parity checks, model card, benchmark."""
