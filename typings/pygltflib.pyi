"""Types of the parts of pygltflib that Lumisplat uses. Values come from a file unchecked: any attribute may be None."""

from typing import Any

_Extensions = dict[str, Any] | None

class Asset:
    version: str | None

class Buffer:
    uri: str | None
    byteLength: int | None

class BufferView:
    buffer: int | None
    byteOffset: int | None
    byteLength: int | None
    byteStride: int | None

class AccessorSparseIndices:
    bufferView: int | None
    byteOffset: int | None
    componentType: int | None

class AccessorSparseValues:
    bufferView: int | None
    byteOffset: int | None

class Sparse:
    count: int | None
    indices: AccessorSparseIndices | None
    values: AccessorSparseValues | None

class Accessor:
    bufferView: int | None
    byteOffset: int | None
    componentType: int | None
    count: int | None
    type: str | None
    normalized: bool | None
    sparse: Sparse | None

class Attributes: ...

class Primitive:
    attributes: Attributes
    indices: int | None
    material: int | None
    mode: int | None
    targets: list[dict[str, int]] | None

class Mesh:
    name: str | None
    primitives: list[Primitive]
    weights: list[float] | None

class Skin:
    joints: list[int] | None
    inverseBindMatrices: int | None

class Node:
    name: str | None
    children: list[int] | None
    mesh: int | None
    skin: int | None
    camera: int | None
    extensions: _Extensions
    matrix: list[float] | None
    translation: list[float] | None
    rotation: list[float] | None
    scale: list[float] | None

class Scene:
    nodes: list[int] | None

class AnimationChannelTarget:
    node: int | None
    path: str | None

class AnimationChannel:
    sampler: int | None
    target: AnimationChannelTarget | None

class AnimationSampler:
    input: int | None
    output: int | None
    interpolation: str | None

class Animation:
    name: str | None
    channels: list[AnimationChannel] | None
    samplers: list[AnimationSampler] | None

class TextureInfo:
    index: int
    texCoord: int | None
    extensions: _Extensions

class PbrMetallicRoughness: ...

class Material:
    name: str | None
    alphaMode: str | None
    emissiveFactor: list[float] | None
    extensions: _Extensions
    normalTexture: TextureInfo | None
    occlusionTexture: TextureInfo | None
    pbrMetallicRoughness: PbrMetallicRoughness | None

class Texture:
    source: int | None
    extensions: _Extensions

class Image:
    name: str | None
    bufferView: int | None
    uri: str | None

class Perspective:
    aspectRatio: float | None

class Orthographic: ...

class Camera:
    name: str | None
    type: str | None
    perspective: Perspective | None
    orthographic: Orthographic | None

class GLTF2:
    asset: Asset
    scene: int | None
    scenes: list[Scene] | None
    nodes: list[Node]
    materials: list[Material] | None
    animations: list[Animation] | None
    extensions: _Extensions
    extensionsRequired: list[str] | None
    @classmethod
    def gltf_from_json(cls, json_data: str) -> GLTF2: ...
