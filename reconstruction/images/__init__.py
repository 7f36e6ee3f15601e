"""What pictures alone say: silhouettes, line orientation, hair features, segmentation."""
