"""From tangents to strands: envelope, orientation field, growth, rooting."""
