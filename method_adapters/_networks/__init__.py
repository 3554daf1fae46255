"""The networks of the ported methods: the part of the adapters that needs torch.

Parameter names and shapes are those of the published checkpoints.
"""
