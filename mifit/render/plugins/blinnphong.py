"""The Blinn-Phong BSDF as a Mitsuba plugin."""

from __future__ import annotations

from mifit.appearance.arrays import dr, mi
from mifit.appearance.lobe import EXPONENT_MAX, EXPONENT_MIN


def make() -> type:
    """Define the plugin class for the current variant."""
    from mifit.appearance.kernels import carried_lobe, fresnel_factor, normalization

    class BlinnPhong(mi.BSDF):
        r"""
        Blinn-Phong reflection (`blinnphong`)
        -------------------------------------

        A diffuse base and a specular lobe about the half vector $h$ of view and light:

        $$f = \frac{C_d}{\pi} + C_s\, N(m)\, (n' \cdot h)^m$$

        - `diffuse_reflectance` (texture, default 0.5): $C_d$, reflectance 0..1
        - `specular_reflectance` (texture, default 0.04): $C_s$, reflectance 0..1
        - `exponent` (float or texture, default 20): $m$, 1..10000; values outside are clamped
        - `normal_correction` (texture, optional): its channels $(a, b)$ turn the normal to
          $n' = \mathrm{normalize}(n + a\,s + b\,t)$ in the shading frame $(s, t, n)$; raw slopes of either sign; a
          third channel is ignored
        - `normalized` (bool, default true): which $N(m)$
        - `fresnel` (float or texture, optional): how much stronger the lobe is at grazing angles, see below

        Normalised, $N(m) = \frac{(m+2)(m+4)}{8\pi\,(m + 2^{-m/2})}$: the lobe alone reflects all light at normal
        incidence and less elsewhere; where $C_d + C_s > 1$ both are divided by their sum, so that no energy is gained.
        Otherwise $N = 1/\pi$: the paper's plain $C_s\,(n \cdot h)^m$ in the units of the diffuse term, which doesn't
        conserve energy.

        With `fresnel`, $k$ below, the lobe is that of fits of skin. It has the shape of a view along the normal, is
        carried about the mirror direction $r$ of the view $v$, and rises as Schlick's approximation does,

        $$f_s = C_s\, \big(1 + k\,(1 - h \cdot v)^5\big)\, N(m)\, \Big(\frac{1 + c}{2}\Big)^{m/2} c\;
        \frac{2}{n' \cdot l + n' \cdot v}, \qquad c = \max(r \cdot l, 0)$$

        It is reciprocal. At the mirror direction $h \cdot v = n' \cdot v$, the factor that `shdirect` and mifit's own
        renders have. A `fresnel` of 0 is the carried lobe without that factor. Normalised, the albedo with its factor
        stops at $1 - C_d$, so that no energy is gained.

        The normal correction is the paper's $\delta_n$ as slopes in the tangent plane instead of spherical coordinates,
        which have a pole at the uncorrected normal. The shading frame's $s$ follows the UV parametrisation.

        Reflects on the side of the normal; wrap it in Mitsuba's `twosided` for both. Where a corrected
        normal faces away from the view and the surface doesn't, the diffuse base still reflects and
        the lobe doesn't: a coarse mesh has no black outline. All parameters are differentiable.
        """

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.diffuse = props.get_texture("diffuse_reflectance", 0.5)
            self.specular = props.get_texture("specular_reflectance", 0.04)
            self.exponent = props.get_unbounded_texture("exponent", 20.0)
            corrected = "normal_correction" in props
            self.correction = props.get_unbounded_texture("normal_correction") if corrected else None
            self.fresnel = props.get_unbounded_texture("fresnel") if "fresnel" in props else None
            self.normalized = bool(props.get("normalized", True))
            self._set_flags()

        def _set_flags(self) -> None:
            textures = [self.diffuse, self.specular, self.exponent, self.fresnel]
            varying = self.correction is not None or any(t.is_spatially_varying() for t in textures if t is not None)
            common = mi.BSDFFlags.FrontSide | (mi.BSDFFlags.SpatiallyVarying if varying else mi.BSDFFlags.Empty)
            self.m_components = [mi.BSDFFlags.GlossyReflection | common, mi.BSDFFlags.DiffuseReflection | common]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def traverse(self, callback: mi.TraversalCallback) -> None:
            callback.put("diffuse_reflectance", self.diffuse, mi.ParamFlags.Differentiable)
            callback.put("specular_reflectance", self.specular, mi.ParamFlags.Differentiable)
            callback.put("exponent", self.exponent, mi.ParamFlags.Differentiable)
            if self.correction is not None:
                callback.put("normal_correction", self.correction, mi.ParamFlags.Differentiable)
            if self.fresnel is not None:
                callback.put("fresnel", self.fresnel, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: list[str]) -> None:
            self._set_flags()

        def parameters(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> tuple[mi.Color3f, ...]:
            """Both albedos, exponent, Fresnel factor (or None) and corrected local normal at a surface point."""
            diffuse = self.diffuse.eval(si, active)
            specular = self.specular.eval(si, active)
            if self.normalized:
                total = dr.maximum(diffuse + specular, 1.0)
                diffuse, specular = diffuse / total, specular / total
            exponent = dr.clip(self.exponent.eval_1(si, active), EXPONENT_MIN, EXPONENT_MAX)
            fresnel = None if self.fresnel is None else dr.maximum(self.fresnel.eval_1(si, active), 0.0)
            if self.correction is None:
                return diffuse, specular, exponent, fresnel, mi.Normal3f(0.0, 0.0, 1.0)
            slopes = self.correction.eval_3(si, active)
            n = mi.Normal3f(dr.normalize(mi.Vector3f(slopes.x, slopes.y, 1.0)))
            return diffuse, specular, exponent, fresnel, n

        def at_angle(self, diffuse: mi.Color3f, specular: mi.Float, fresnel: mi.Float, cosine: mi.Float) -> mi.Color3f:
            """Specular albedo with its Fresnel factor at a cosine, stopped where it would gain energy."""
            if fresnel is None:
                return specular
            value = specular * fresnel_factor(cosine, fresnel)
            return dr.minimum(value, dr.maximum(1.0 - diffuse, 0.0)) if self.normalized else value

        def _half(self, wi: mi.Vector3f, wo: mi.Vector3f) -> mi.Vector3f:
            h = wi + wo
            return h * dr.rsqrt(dr.maximum(dr.squared_norm(h), 1e-12))

        def _lobe(
            self, wi: mi.Vector3f, wo: mi.Vector3f, n: mi.Vector3f, exponent: mi.Float, fresnel: mi.Float
        ) -> tuple[mi.Float, mi.Float]:
            """The lobe without albedo and N(m), and the density of wo when it is sampled."""
            if fresnel is not None:
                return carried_lobe(wi, wo, n, exponent)
            h = self._half(wi, wo)
            cos_h, wi_h = dr.dot(h, n), dr.dot(wi, h)
            # The power of a floor instead of zero keeps the derivative by the exponent finite.
            power = dr.select(cos_h > 0.0, dr.power(dr.clip(cos_h, 1e-4, 1.0), exponent), 0.0)
            density = (exponent + 1.0) * dr.inv_two_pi * power / dr.maximum(4.0 * wi_h, 1e-8)
            return power, dr.select(wi_h > 0.0, density, 0.0)

        def _specular_probability(
            self, ctx: mi.BSDFContext, wi: mi.Vector3f, parameters: tuple[mi.Color3f, ...]
        ) -> mi.Float:
            """Probability of sampling the lobe: the share of its albedo; none where the normal faces away."""
            has_specular = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0)
            has_diffuse = ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 1)
            if not has_diffuse:
                return mi.Float(1.0)
            if not has_specular:
                return mi.Float(0.0)
            diffuse, specular, _, fresnel, n = dr.detach(parameters)
            cosine = dr.dot(wi, n)
            s, d = dr.mean(self.at_angle(diffuse, specular, fresnel, cosine)), dr.mean(diffuse)
            facing = (cosine > 0.0) & (mi.Frame3f.cos_theta(wi) > 0.0)
            return dr.select(facing, dr.select(s + d > 0.0, s / dr.maximum(s + d, 1e-12), 0.5), 0.0)

        def _reflects(self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, n: mi.Vector3f) -> tuple[mi.Bool, ...]:
            """Where the base reflects, where the lobe does as well, and the corrected cosine of wo."""
            cosine, facing = dr.dot(wo, n), mi.Frame3f.cos_theta(si.wi) > 0.0
            front = facing | (dr.dot(si.n, si.to_world(si.wi)) > 0.0)
            above = front & (mi.Frame3f.cos_theta(wo) > 0.0) & (cosine > 0.0)
            return above, above & facing & (dr.dot(si.wi, n) > 0.0), cosine

        def _both(
            self,
            ctx: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            wo: mi.Vector3f,
            parameters: tuple[mi.Color3f, ...],
            active: mi.Bool,
        ) -> tuple[mi.Spectrum, mi.Float]:
            """The value times the cosine, and the density of wo when it is sampled."""
            diffuse, specular, exponent, fresnel, n = parameters
            wi = si.wi
            reflects, shines, cosine = self._reflects(si, wo, n)
            lobe, density = self._lobe(wi, wo, n, exponent, fresnel)
            value = mi.Spectrum(0.0)
            if ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
                factor = normalization(exponent) if self.normalized else dr.inv_pi
                albedo = self.at_angle(diffuse, specular, fresnel, dr.dot(wi, self._half(wi, wo)))
                value += dr.select(shines, albedo * (factor * lobe), 0.0)
            if ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 1):
                value += diffuse * dr.inv_pi
            p = self._specular_probability(ctx, wi, parameters)
            density = dr.lerp(cosine * dr.inv_pi, dr.select(shines, density, 0.0), p)
            lit = active & reflects
            return dr.select(lit, value * cosine, 0.0), dr.select(lit, density, 0.0)

        def eval(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> mi.Spectrum:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> mi.Float:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> tuple[mi.Spectrum, mi.Float]:
            return self._both(ctx, si, wo, self.parameters(si, active), active)

        def sample(
            self,
            ctx: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            sample1: mi.Float,
            sample2: mi.Point2f,
            active: mi.Bool = True,
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            parameters = self.parameters(si, active)
            _, _, exponent, fresnel, n = dr.detach(parameters)
            p = self._specular_probability(ctx, si.wi, parameters)
            frame = mi.Frame3f(n)
            take_lobe = sample1 < p

            # One warp for both lobes: the half vector about n, or half the angle to the mirror direction.
            power = exponent + (1.0 if fresnel is None else 2.0)
            cos_h = dr.power(dr.maximum(sample2.x, 1e-30), 1.0 / power)
            sin_h = dr.safe_sqrt(1.0 - dr.square(cos_h))
            sin_phi, cos_phi = dr.sincos(dr.two_pi * sample2.y)
            if fresnel is None:
                h = frame.to_world(mi.Vector3f(sin_h * cos_phi, sin_h * sin_phi, cos_h))
                about_h = dr.fma(h, 2.0 * dr.dot(si.wi, h), -si.wi)
            else:
                mirror = mi.Frame3f(dr.fma(mi.Vector3f(n), 2.0 * dr.dot(si.wi, n), -si.wi))
                sine = 2.0 * sin_h * cos_h
                about_h = mirror.to_world(mi.Vector3f(sine * cos_phi, sine * sin_phi, 2.0 * dr.square(cos_h) - 1.0))
            about_n = frame.to_world(mi.warp.square_to_cosine_hemisphere(sample2))

            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = dr.select(take_lobe, about_h, about_n)
            bs.eta = 1.0
            bs.sampled_component = dr.select(take_lobe, mi.UInt32(0), mi.UInt32(1))
            bs.sampled_type = dr.select(
                take_lobe, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            )
            value, density = self._both(ctx, si, bs.wo, parameters, active)
            bs.pdf = dr.detach(density)
            valid = active & (bs.pdf > 0.0)
            return bs, dr.select(valid, value / dr.select(valid, bs.pdf, 1.0), 0.0)

        def eval_diffuse_reflectance(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
            return self.parameters(si, active)[0]

        def to_string(self) -> str:
            more = "" if self.correction is None else f"  normal_correction = {self.correction},\n"
            more += "" if self.fresnel is None else f"  fresnel = {self.fresnel},\n"
            return (
                "BlinnPhong[\n"
                f"  diffuse_reflectance = {self.diffuse},\n"
                f"  specular_reflectance = {self.specular},\n"
                f"  exponent = {self.exponent},\n{more}"
                f"  normalized = {self.normalized}\n]"
            )

    return BlinnPhong
