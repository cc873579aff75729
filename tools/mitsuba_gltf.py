"""Mitsuba's plugin ``gltf_dielectric``: the dielectric of glTF 2.0's metallic-roughness material, without metal.

The BSDF is base / pi (1 - F) + F D G / (4 cos cos), with GGX of alpha = roughness ** 2, Smith's separable masking, and
Schlick's F from 0.04 to 1 (glTF 2.0 specification, appendix B.2.2). Mitsuba's ``principled`` is Disney's, whose diffuse
part reflects more light, mostly at grazing angles.
"""

from __future__ import annotations

from typing import Any

F0 = 0.04
MIRRORED = 0.5
"""Fraction of samples that follow the highlight."""


def register(mi: Any) -> None:
    """Registers the plugin, with textures ``base_color`` and ``roughness``; a variant of Mitsuba must be set."""
    mi.register_bsdf("gltf_dielectric", _plugin(mi))


def _plugin(mi: Any) -> type:
    import drjit as dr

    class GltfDielectric(mi.BSDF):
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.base_color, self.roughness = props.get_texture("base_color"), props.get_texture("roughness")
            self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
            self.m_components += [mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def microfacets(self, si: Any, active: Any) -> Any:
            alpha = dr.maximum(dr.square(self.roughness.eval_1(si, active)), 1e-4)
            return mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, sample_visible=True)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any) -> Any:
            diffuse = mi.warp.square_to_cosine_hemisphere(sample2)
            half, _ = self.microfacets(si, active).sample(si.wi, sample2)
            wo = dr.select(sample1 < MIRRORED, mi.reflect(si.wi, half), diffuse)
            value, pdf = self.eval_pdf(ctx, si, wo, active)
            sampled = dr.zeros(mi.BSDFSample3f)
            sampled.wo, sampled.pdf, sampled.eta = wo, pdf, 1.0
            sampled.sampled_component = dr.select(sample1 < MIRRORED, mi.UInt32(1), mi.UInt32(0))
            sampled.sampled_type = mi.UInt32(int(self.m_flags))
            return sampled, dr.select(pdf > 0.0, value / pdf, 0.0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            cos_in, cos_out = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
            active &= (cos_in > 0.0) & (cos_out > 0.0)
            half, microfacets = dr.normalize(si.wi + wo), self.microfacets(si, active)
            fresnel = F0 + (1.0 - F0) * (1.0 - dr.maximum(dr.dot(si.wi, half), 0.0)) ** 5
            highlight = fresnel * microfacets.eval(half) * microfacets.G(si.wi, wo, half) / (4.0 * cos_in)
            diffuse = self.base_color.eval(si, active) * ((1.0 - fresnel) * cos_out / dr.pi)
            along = microfacets.pdf(si.wi, half) / (4.0 * dr.dot(wo, half))
            pdf = MIRRORED * along + (1.0 - MIRRORED) * cos_out / dr.pi
            return dr.select(active, diffuse + highlight, 0.0), dr.select(active, pdf, 0.0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def traverse(self, callback: Any) -> None:
            callback.put("base_color", self.base_color, mi.ParamFlags.Differentiable)
            callback.put("roughness", self.roughness, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "GltfDielectric[]"

    return GltfDielectric
