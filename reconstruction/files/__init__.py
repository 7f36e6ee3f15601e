"""File formats and durable writes: EXR, images, masks, points, lights, cameras, strands."""
