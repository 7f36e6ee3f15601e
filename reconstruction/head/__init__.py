"""The head under the hair: template, pose, shape, scalp and its map."""
