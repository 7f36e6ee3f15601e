"""Builds the groom of this folder in Blender 4.5 or newer, written by hairstage.

    blender --python open_in_blender.py
    blender --background --python open_in_blender.py -- --save groom.blend

Hair Curves with the attributes of each strand and point, a Principled Hair BSDF (Chiang) with the
fitted absorption and roughness, guides (hidden in renders), and the head with its skin.
"""

import sys
from pathlib import Path

import bpy
import numpy as np


def build(groom):
    """All objects of the arrays `groom`; returns the hair."""
    bpy.context.scene.render.engine = "CYCLES"
    bpy.context.scene.cycles_curves.shape = "THICK"
    bpy.context.scene.unit_settings.system = "METRIC"
    head = make_head(groom) if "head_vertices" in groom else None
    every = np.arange(len(groom["counts"]))
    hair = make_curves("hair", groom, every, head)
    hair.data.materials.append(hair_material(groom))
    if len(groom["guides"]):
        guides = make_curves("guides", groom, groom["guides"], head)
        guides.hide_render = True
        guides.hide_set(True)
    return hair


def make_curves(name, groom, which, head):
    """The strands `which` as Hair Curves that grow from `head`."""
    counts, ends = groom["counts"], np.cumsum(groom["counts"])
    inside = np.zeros(len(counts), bool)
    inside[which] = True
    points = np.repeat(inside, counts)
    assert ends[-1] == len(points) if len(ends) else True
    curves = bpy.data.hair_curves.new(name)
    if inside.any():  # to add none ends Blender 4.5
        curves.add_curves(counts[inside].tolist())
    fill(curves.attributes["position"], "vector", groom["points"][points])
    add(curves, "radius", "FLOAT", "POINT", groom["radius"][points])
    add(curves, "surface_uv_coordinate", "FLOAT2", "CURVE", groom["root_uv"][inside])
    add(curves, "strand_id", "INT", "CURVE", groom["strand_id"][inside])
    if "clump" in groom:
        add(curves, "clump", "INT", "CURVE", groom["clump"][inside])
    if "confidence" in groom:
        add(curves, "confidence", "FLOAT", "POINT", groom["confidence"][points])
    if len(groom["sigma_a"]) > 1:
        add(curves, "sigma_a", "FLOAT_VECTOR", "POINT", groom["sigma_a"][points])
    made = bpy.data.objects.new(name, curves)
    bpy.context.scene.collection.objects.link(made)
    if head is not None:
        curves.surface = head
        if head.data.uv_layers:
            curves.surface_uv_map = head.data.uv_layers[0].name
    return made


def add(data, name, kind, domain, values):
    """An attribute of `data`, new or filled anew."""
    attribute = data.attributes.get(name) or data.attributes.new(name, kind, domain)
    fill(attribute, "vector" if values.ndim > 1 else "value", values)


def fill(attribute, field, values):
    attribute.data.foreach_set(field, np.ascontiguousarray(values).ravel())


def hair_material(groom):
    """Principled Hair by absorption: its parameters are the fitted ones, without conversion."""
    material = bpy.data.materials.new("hair")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    bsdf = nodes.new("ShaderNodeBsdfHairPrincipled")
    bsdf.model, bsdf.parametrization = "CHIANG", "ABSORPTION"
    values = {
        "Roughness": groom["beta_m"],
        "Radial Roughness": groom["beta_n"],
        "IOR": groom["eta"],
        "Offset": np.radians(groom["tilt_deg"]),
        "Coat": 0.0,
        "Random Roughness": 0.0,
    }
    for name, value in values.items():
        bsdf.inputs[name].default_value = float(value)
    absorption = bsdf.inputs["Absorption Coefficient"]
    if len(groom["sigma_a"]) == 1:
        absorption.default_value = groom["sigma_a"][0].tolist()
    else:
        attribute = nodes.new("ShaderNodeAttribute")
        attribute.attribute_name = "sigma_a"
        links.new(attribute.outputs["Vector"], absorption)
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(bsdf.outputs[0], output.inputs["Surface"])
    return material


def make_head(groom):
    """The head, Lambertian as the fit takes it, its scalp's map as UV."""
    mesh = bpy.data.meshes.new("head")
    mesh.from_pydata(groom["head_vertices"].tolist(), [], groom["head_faces"].tolist())
    if "head_uv" in groom:
        mesh.uv_layers.new(name="scalp").data.foreach_set("uv", groom["head_uv"].ravel())
    material = bpy.data.materials.new("skin")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    diffuse = nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = (*groom["skin"].tolist(), 1.0)
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(diffuse.outputs[0], output.inputs["Surface"])
    mesh.materials.append(material)
    made = bpy.data.objects.new("head", mesh)
    bpy.context.scene.collection.objects.link(made)
    return made


def main():
    for start in ("Cube", "Light", "Camera"):  # what a new file of Blender's holds
        if start in bpy.data.objects:
            bpy.data.objects.remove(bpy.data.objects[start])
    with np.load(Path(__file__).resolve().with_name("groom.npz")) as data:
        build(dict(data))
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []
    if words[:1] == ["--save"]:
        bpy.ops.wm.save_as_mainfile(filepath=str(Path(words[1]).resolve()))


if __name__ == "__main__":
    main()
