"""A room as Blender's exporter for Mitsuba writes it: its plugins, nesting, ids and transforms."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.cli import main
from tests.helpers import SCENES, at, camera

pytestmark = pytest.mark.usefixtures("variant")

#: What the exporter makes of materials: twosided around everything that lets no light through.
MATERIALS = """
<bsdf type="twosided" id="mat-Wall"> <bsdf type="principled">
    <rgb name="base_color" value="0.8 0.75 0.7"/> <float name="specular" value="0.5"/>
    <float name="roughness" value="0.5"/> <float name="metallic" value="0"/>
    <float name="anisotropic" value="0"/> <float name="sheen" value="0"/>
    <float name="sheen_tint" value="0.5"/> <float name="spec_tint" value="0"/>
    <float name="clearcoat" value="0"/> <float name="clearcoat_gloss" value="0.97"/>
</bsdf> </bsdf>
<bsdf type="twosided" id="mat-Wood"> <bsdf type="principled">
    <texture type="bitmap" name="base_color"> <string name="filename" value="wood.jpg"/> </texture>
    <float name="specular" value="0.5"/> <float name="roughness" value="0.4"/>
</bsdf> </bsdf>
<bsdf type="twosided" id="mat-Brass"> <bsdf type="principled">
    <rgb name="base_color" value="0.8 0.6 0.3"/> <float name="metallic" value="1"/>
    <float name="roughness" value="0.3"/>
</bsdf> </bsdf>
<bsdf type="dielectric" id="mat-Glass"> <float name="int_ior" value="1.45"/> </bsdf>
<bsdf type="blendbsdf" id="mat-Mix"> <float name="weight" value="0.5"/>
    <bsdf type="twosided"> <bsdf type="diffuse">
        <rgb name="reflectance" value="0.1 0.3 0.6"/> </bsdf> </bsdf>
    <bsdf type="twosided"> <bsdf type="roughconductor"> <float name="alpha" value="0.2"/>
        <string name="distribution" value="ggx"/> </bsdf> </bsdf>
</bsdf>
<bsdf type="mask" id="mat-Leaf"> <float name="opacity" value="0.5"/>
    <bsdf type="twosided"> <bsdf type="diffuse">
        <rgb name="reflectance" value="0.2 0.5 0.1"/> </bsdf> </bsdf>
</bsdf>
<bsdf type="principledthin" id="mat-Paper"> <rgb name="base_color" value="0.7 0.7 0.6"/>
    <float name="roughness" value="1"/> <float name="diff_trans" value="1"/> </bsdf>
<bsdf type="diffuse" id="empty-emitter-bsdf"> <rgb name="reflectance" value="0"/> </bsdf>
"""
#: An area lamp has a null material and flipped normals; strength comes as radiance.
LIGHTS = """
<shape type="rectangle" id="emit-Area"> <boolean name="flip_normals" value="true"/>
    <transform name="to_world"> <matrix value="0.4 0 0 0  0 0.4 0 0  0 0 0.4 1.9  0 0 0 1"/>
    </transform>
    <emitter type="area"> <rgb name="radiance" value="9 9 8"/> </emitter> <bsdf type="null"/>
</shape>
<emitter type="point" id="emit-Point"> <point name="position" x="-1.2" y="-1" z="1"/>
    <rgb name="intensity" value="0.5 0.4 0.3"/> </emitter>
<emitter type="spot" id="emit-Spot"> <rgb name="intensity" value="2 2 2"/>
    <float name="cutoff_angle" value="35"/> <float name="beam_width" value="25"/>
    <transform name="to_world">
        <lookat origin="1.5 -1.5 1.5" target="0 1 -1.5" up="0 0 1"/> </transform> </emitter>
<emitter type="constant" id="World"> <rgb name="radiance" value="0.05 0.05 0.05"/> </emitter>
"""


def mesh(name: str, material: str, x=0.0, y=0.0, z=0.0, size=1.0, more="") -> str:
    return (
        f'<shape type="ply" id="mesh-{name}-{x}{y}"> <string name="filename" value="{name}.ply"/>'
        f'<transform name="to_world"> <matrix value="{size} 0 0 {x}  0 {size} 0 {y}  '
        f'0 0 {size} {z}  0 0 0 1"/> </transform> {more} <ref id="{material}" name="bsdf"/></shape>'
    )


def instances() -> str:
    """Copies of one object share a group."""
    group = '<shape type="shapegroup" id="mesh-Mug">' + mesh("mug", "mat-Mix", size=3) + "</shape>"
    return group + "".join(
        f'<shape type="instance"> <ref id="mesh-Mug"/> <transform name="to_world">'
        f'<matrix value="1 0 0 {x}  0 1 0 0.9  0 0 1 -2  0 0 0 1"/> </transform> </shape>'
        for x in (-0.9, -0.4)
    )


@pytest.fixture(scope="module")
def exported(variant, tmp_path_factory):
    """The file, beside its meshes and textures."""
    folder = tmp_path_factory.mktemp("exported")
    mi.load_dict({"type": "cube"}).write_ply(str(folder / "cube.ply"))
    for source in ("meshes/mug.ply", "meshes/vase.ply", "meshes/bowl.ply", "textures/wood.jpg"):
        path = SCENES / source
        (folder / path.name).write_bytes(path.read_bytes())
    lamp = '<emitter type="area"> <rgb name="radiance" value="4 2 1"/> </emitter>'
    shapes = [
        mesh("cube", "mat-Wall", size=2),
        mesh("cube", "mat-Wood", 0, 0.6, -1.8, 0.2),
        mesh("cube", "mat-Leaf", 1.3, 0.5, -1, 0.3),
        mesh("cube", "empty-emitter-bsdf", -1.7, 1, 0, 0.1, lamp),
        mesh("cube", "mat-Paper", -1.2, 1.2, -1.6, 0.3),
        mesh("vase", "mat-Brass", 0, 0.6, -1.6, 2),
        mesh("bowl", "mat-Glass", 0.7, -0.2, -1.98, 3),
    ]
    sensor = camera(64, 48)
    rows = np.array(sensor["to_world"].matrix).reshape(-1)
    (folder / "room.xml").write_text(
        f"""<scene version="3.0.0">
        <integrator type="path"> <integer name="max_depth" value="12"/> </integrator>
        <sensor type="perspective" id="Camera"> <string name="fov_axis" value="x"/>
            <float name="fov" value="80"/> <float name="principal_point_offset_x" value="0"/>
            <float name="principal_point_offset_y" value="0"/>
            <float name="near_clip" value="0.1"/> <float name="far_clip" value="100"/>
            <transform name="to_world"> <matrix value="{" ".join(map(str, rows))}"/> </transform>
            <sampler type="independent"> <integer name="sample_count" value="64"/> </sampler>
            <film type="hdrfilm"> <integer name="width" value="64"/>
                <integer name="height" value="48"/> <rfilter type="box"/> </film> </sensor>
        {MATERIALS} {LIGHTS} {"".join(shapes)} {instances()} </scene>"""
    )
    return folder / "room.xml"


def test_it_renders_as_by_path(exported, tmp_path, artefacts):
    """The exporter's limit of path's depth goes with path."""
    output = tmp_path / "room.exr"
    options = ("--integrator", "envmap_hybrid", "--spp", "128", "--quiet", "-o", str(output))
    options += ("--set", "patch_samples=128")  # Of so small a film it would have noise of its own.
    assert main(["render", str(exported), *options]) == 0
    ours = np.array(mi.Bitmap(str(output)))[:, :, :3]
    scene = mi.load_file(str(exported))
    path = mi.load_dict({"type": "path", "max_depth": -1})
    theirs = np.array(mi.render(scene, integrator=path, spp=512))[:, :, :3]
    artefacts["ours"], artefacts["path"] = ours, theirs
    assert ours.mean() == pytest.approx(theirs.mean(), rel=0.008)
    # By tiles of 8 x 8 pixels, and without the brightest, where caustics of the bowl may lie.
    one, other = (p.reshape(6, 8, 8, 8, 3).mean(axis=(1, 3)) for p in (ours, theirs))
    assert np.quantile(np.abs(one - other) / (other + 0.1 * other.mean()), 0.9) < 0.06


def test_orthographic(exported):
    """The other camera that is written."""
    scene = mi.load_file(str(exported))
    to_world = at(0, -1.9, -0.5) @ mi.ScalarTransform4f().rotate([1, 0, 0], -90)
    sensor = mi.load_dict(
        {"type": "orthographic", "near_clip": 0.001, "far_clip": 250.0, "to_world": to_world}
        | {"film": camera(32, 32)["film"]}
    )
    one, other = (
        np.array(mi.render(scene, sensor=sensor, integrator=mi.load_dict(kind), spp=spp)).mean()
        for kind, spp in (({"type": "envmap_hybrid"}, 64), ({"type": "path"}, 1024))
    )
    assert one == pytest.approx(other, rel=0.025)
