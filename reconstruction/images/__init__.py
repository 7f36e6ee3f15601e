"""Image analysis: silhouettes, line orientation, hair features, visual hull."""
