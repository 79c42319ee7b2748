"""Models of a walking person and a rolling cart: articulated rigid bodies with textures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from beamsplat.tools.simulator import textures as tx
from beamsplat.tools.simulator.mesh import Material, MeshBuilder, SceneMesh, merge
from beamsplat.tools.simulator.palette import Textures
from beamsplat.tools.simulator.shapes import box, cushion, lathe, rod
from beamsplat.tools.simulator.textures import rgb

STRIDE_M = 1.25  # length of a gait cycle (two steps)


def clothes(rng: np.random.Generator) -> Textures:
    """Return the textures of persons (shirts, trousers, skin, hair, shoes) by name, also for carts."""
    shirts = [
        tx.plaid(rng, [rgb("8c2f39"), rgb("e0d5c1"), rgb("2c3e50")]),
        tx.stripes(rng, rgb("e9e4d8"), rgb("31506e"), 256),
        tx.weave(rng, rgb("c7923e"), strength=0.1),
        tx.dots(rng, rgb("3d5a50"), rgb("d8d2c0")),
    ]
    return {
        **{f"shirt_{k}": (texture, (0.3, 0.3)) for k, texture in enumerate(shirts)},
        "denim": (tx.weave(rng, rgb("3a5273"), strength=0.12, melange=0.08), (0.08, 0.08)),
        "chino": (tx.weave(rng, rgb("8d7c62"), strength=0.08), (0.08, 0.08)),
        "skin": (tx.flat(rng, rgb("d6a585"), depth=0.03), (0.3, 0.3)),
        "hair": (tx.brushed(rng, rgb("3d2b1f")), (0.2, 0.2)),
        "shoe": (tx.flat(rng, rgb("4a3a30"), depth=0.08), (0.2, 0.2)),
    }


@dataclass(frozen=True)
class BodyLink:
    """A rigid link of an articulated body; the origin of its frame is its joint.

    `parent` is the index of the parent link, -1 for the root. `joint_m` is the position of the joint in the
    frame of the parent link; for the root, in the frame of the body on the floor.
    """

    mesh: SceneMesh
    parent: int
    joint_m: tuple[float, float, float]


@dataclass(frozen=True)
class ArticulatedBody:
    """An articulated body; in `parts`, every parent link precedes its children."""

    parts: tuple[BodyLink, ...]
    kind: str  # person or cart
    whole: SceneMesh  # all links merged, in the same order

    def posed(self, x_m: float, y_m: float, yaw_rad: float, travelled_m: float) -> SceneMesh:
        """Return the body's mesh in the world frame, with its limbs at the gait phase of `travelled_m`."""
        angles, lift = _gait(travelled_m) if self.kind == "person" else ([0.0] * len(self.parts), 0.0)
        frames: list[tuple[np.ndarray, np.ndarray]] = []
        vertices, normals = [], []
        for part, angle in zip(self.parts, angles):
            if part.parent < 0:
                cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
                R = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
                t = np.array([x_m, y_m, lift]) + R @ np.array(part.joint_m)
            else:
                R0, t0 = frames[part.parent]
                cos, sin = np.cos(angle), np.sin(angle)
                R = R0 @ np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
                t = R0 @ np.array(part.joint_m) + t0
            frames.append((R, t))
            vertices.append(part.mesh.vertices_m @ R.T + t)
            normals.append(part.mesh.normals @ R.T)
        return self.whole.posed(np.concatenate(vertices), np.concatenate(normals))


def _gait(travelled_m: float) -> tuple[list[float], float]:
    """Return the joint angles in link order and the vertical motion of the pelvis in metres.

    Angles are radians about the y axis (left): a positive angle swings a hanging limb backwards.
    """
    phase = 2 * np.pi * travelled_m / STRIDE_M
    angles = [0.0, 0.0]  # pelvis, head
    for side in (0.0, np.pi):
        hip = -0.42 * np.sin(phase + side)
        knee = 0.12 + 0.75 * max(0.0, np.sin(phase + side + 1.9)) ** 2
        arm = 0.40 * np.sin(phase + side)
        angles += [hip, knee, -0.3 * knee, arm, -0.35 - 0.15 * np.sin(phase + side)]
    return angles, 0.018 * np.cos(2 * phase) - 0.018


def person(rng: np.random.Generator, sizes: dict[str, tuple[float, float]]) -> ArticulatedBody:
    """Return a random person, 1.6 to 1.85 m tall, facing +x.

    `sizes` maps the name of a texture to the width and height in metres of one repeat.
    """
    scale = float(rng.uniform(0.93, 1.06))
    shirt = Material(f"shirt_{int(rng.integers(4))}")
    trousers = Material(str(rng.choice(["denim", "chino"])))
    tone = float(rng.uniform(0.45, 1.05))
    skin, hair = (
        Material("skin", tint=(tone, tone, tone)),
        Material("hair", tint=(1, 1, float(rng.uniform(0.7, 1.2)))),
    )

    def part(draw: Callable[[MeshBuilder], None], parent: int, joint: tuple[float, float, float]) -> BodyLink:
        b = MeshBuilder(sizes, edge_m=0.12)
        draw(b)
        mesh = b.build()
        scaled = mesh.posed(mesh.vertices_m * scale, mesh.normals)
        return BodyLink(scaled, parent, (joint[0] * scale, joint[1] * scale, joint[2] * scale))

    def torso(b: MeshBuilder) -> None:
        profile = [
            (0.0, -0.10),
            (0.14, -0.08),
            (0.165, 0.02),
            (0.15, 0.14),
            (0.175, 0.32),
            (0.185, 0.44),
            (0.15, 0.53),
            (0.07, 0.58),
            (0.055, 0.62),
        ]
        _oval(b, profile[:4], 0.75, trousers)
        _oval(b, profile[2:-1], 0.68, shirt)
        _oval(b, profile[-2:], 0.95, skin)

    def head(b: MeshBuilder) -> None:
        lathe(b, (0, 0, -0.04), [(0.055, 0.0), (0.05, 0.1)], skin, sides=12)
        cushion(b, (0.015, 0, 0.02), (0.19, 0.15, 0.24), skin, power=1, squash=1, detail=14)
        cushion(b, (-0.012, 0, 0.075), (0.205, 0.175, 0.205), hair, power=1, squash=1, detail=14)
        cushion(b, (0.105, 0, 0.10), (0.03, 0.03, 0.05), skin, power=1, squash=1, detail=6)

    def thigh(b: MeshBuilder) -> None:
        lathe(
            b,
            (0, 0, -0.46),
            [(0.062, 0.0), (0.072, 0.15), (0.09, 0.36), (0.092, 0.44), (0.05, 0.5)],
            trousers,
        )

    def shin(b: MeshBuilder) -> None:
        lathe(
            b, (0, 0, -0.40), [(0.056, 0.0), (0.06, 0.1), (0.07, 0.26), (0.066, 0.38), (0.03, 0.43)], trousers
        )

    def foot(b: MeshBuilder) -> None:
        cushion(b, (0.055, 0, -0.075), (0.27, 0.10, 0.10), Material("shoe"), power=0.5, squash=0.6, detail=12)

    def upper_arm(b: MeshBuilder) -> None:
        lathe(b, (0, 0, -0.28), [(0.04, 0.0), (0.046, 0.12), (0.055, 0.26), (0.03, 0.31)], shirt, sides=12)

    def fore_arm(b: MeshBuilder) -> None:
        sleeve = shirt if tone > 0.7 else skin
        lathe(b, (0, 0, -0.24), [(0.03, 0.0), (0.042, 0.18), (0.03, 0.25)], sleeve, sides=12)
        cushion(b, (0.01, 0, -0.36), (0.09, 0.045, 0.14), skin, power=0.7, squash=0.7, detail=8)

    parts = [part(torso, -1, (0.0, 0.0, 0.95)), part(head, 0, (0.0, 0.0, 0.60))]
    for side in (1, -1):
        first = len(parts)
        parts.append(part(thigh, 0, (0.0, side * 0.095, -0.03)))
        parts.append(part(shin, first, (0.0, 0.0, -0.44)))
        parts.append(part(foot, first + 1, (0.0, 0.0, -0.395)))
        parts.append(part(upper_arm, 0, (0.0, side * 0.215, 0.47)))
        parts.append(part(fore_arm, first + 3, (0.0, 0.0, -0.28)))
    return ArticulatedBody(tuple(parts), "person", merge(p.mesh for p in parts))


def _oval(b: MeshBuilder, profile: list[tuple[float, float]], flat: float, material: Material) -> None:
    """Draw a body of revolution about z, scaled by the factor `flat` along x (front to back)."""
    inner = MeshBuilder(b.texture_size_m, b.edge_m)
    lathe(inner, (0, 0, 0), profile, material, sides=20)
    mesh = inner.build()
    squeeze = np.array([flat, 1.0, 1.0])
    normals = mesh.normals / squeeze
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    b.add(mesh.vertices_m * squeeze, normals, mesh.uvs, mesh.triangles, material)


def cart(rng: np.random.Generator, sizes: dict[str, tuple[float, float]]) -> ArticulatedBody:
    """Return a serving trolley 0.75 m high with boxes on it, facing +x; `sizes` as for `person`."""
    b = MeshBuilder(sizes, edge_m=0.12)
    for z in (0.14, 0.44, 0.72):
        box(b, (0, 0, z), (0.62, 0.42, 0.025), Material("oak"))
    for x in (-0.29, 0.29):
        for y in (-0.19, 0.19):
            rod(b, (x, y, 0.08), (x, y, 0.78), 0.013, Material("steel"))
            rod(b, (x, y - 0.012, 0.045), (x, y + 0.012, 0.045), 0.045, Material("black"), sides=14)
    for z, name in ((0.165, "shirt_1"), (0.465, "cushion_b"), (0.745, "shirt_0")):
        for x in (-0.15, 0.14):
            size = rng.uniform((0.18, 0.2, 0.12), (0.26, 0.34, 0.2))
            box(b, (x, 0.0, z), tuple(size.tolist()), Material(name))
    mesh = b.build()
    return ArticulatedBody((BodyLink(mesh, -1, (0.0, 0.0, 0.0)),), "cart", mesh)
