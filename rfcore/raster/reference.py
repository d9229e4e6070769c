"""The definition of the rasterizer, in torch: obvious, differentiable, slow."""
