"""Our surface model, two-sided Lambert plus a normalised Phong lobe, as a Mitsuba 3 BSDF in Python: Mitsuba has none.

`register()` makes it known to the current variant as `jaxvol_phong`; scenes with a Phong lobe load only after that.
"""

import math

NAME = "jaxvol_phong"
PARAMETERS = ("albedo_r", "albedo_g", "albedo_b", "specular_r", "specular_g", "specular_b", "exponent")


def register() -> None:
    """Make `jaxvol_phong` known to Mitsuba's current variant, an rgb one; needs Mitsuba."""
    import drjit
    import mitsuba

    class Phong(mitsuba.BSDF):
        """albedo / pi + specular (n + 2) / (2 pi) cos^n(mirror, outgoing), as `jaxvol.materials.evaluate`."""

        def __init__(self, properties):
            mitsuba.BSDF.__init__(self, properties)
            values = [float(properties[name]) for name in PARAMETERS]
            self.albedo, self.specular = mitsuba.Color3f(values[:3]), mitsuba.Color3f(values[3:6])
            self.exponent = values[6]
            diffuse, specular = max(values[:3]), max(values[3:6])
            self.share = specular / max(diffuse + specular, 1e-12)
            sides = mitsuba.BSDFFlags.FrontSide | mitsuba.BSDFFlags.BackSide
            self.m_components = [mitsuba.BSDFFlags.DiffuseReflection | sides, mitsuba.BSDFFlags.GlossyReflection | sides]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def _above(self, si, wo):
            """Directions seen from the side of `wi`, and the cosine of the lobe."""
            side = drjit.select(si.wi.z < 0, -1.0, 1.0)
            wi, wo = (mitsuba.Vector3f(w.x, w.y, w.z * side) for w in (si.wi, wo))
            lobe = drjit.maximum(wo.z * wi.z - wo.x * wi.x - wo.y * wi.y, 0.0)
            return wi, wo, lobe

        def eval_pdf(self, ctx, si, wo, active=True):
            _, out, lobe = self._above(si, wo)
            power = drjit.power(drjit.maximum(lobe, 1e-30), self.exponent)
            power = drjit.select(lobe > 0, power, 1.0 if self.exponent == 0 else 0.0)
            cosine = drjit.maximum(out.z, 0.0)
            value = self.albedo * (1 / math.pi) + self.specular * (power * ((self.exponent + 2) / (2 * math.pi)))
            glossy = power * ((self.exponent + 1) / (2 * math.pi))
            pdf = self.share * glossy + (1 - self.share) * cosine * (1 / math.pi)
            valid = active & (out.z > 0)
            return drjit.select(valid, value * cosine, 0.0), drjit.select(valid, pdf, 0.0)

        def eval(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[1]

        def sample(self, ctx, si, sample1, sample2, active=True):
            side = drjit.select(si.wi.z < 0, -1.0, 1.0)
            diffuse = mitsuba.warp.square_to_cosine_hemisphere(sample2)
            cosine = drjit.power(drjit.maximum(sample2.x, 1e-30), 1 / (self.exponent + 1))
            sine = drjit.sqrt(drjit.maximum((1 - cosine) * (1 + cosine), 0.0))
            around = 2 * math.pi * sample2.y
            local = mitsuba.Vector3f(sine * drjit.cos(around), sine * drjit.sin(around), cosine)
            mirror = mitsuba.Vector3f(-si.wi.x, -si.wi.y, si.wi.z * side)
            glossy = mitsuba.Frame3f(mirror).to_world(local)
            wo = drjit.select(sample1 < self.share, glossy, diffuse)
            wo = mitsuba.Vector3f(wo.x, wo.y, wo.z * side)
            value, pdf = self.eval_pdf(ctx, si, wo, active)
            found = drjit.zeros(mitsuba.BSDFSample3f)
            found.wo, found.pdf, found.eta = wo, pdf, 1.0
            found.sampled_type = +mitsuba.BSDFFlags.DiffuseReflection
            found.sampled_component = 0
            return found, drjit.select(pdf > 0, value / drjit.maximum(pdf, 1e-30), 0.0)

        def to_string(self):
            return f"Phong[albedo={self.albedo}, specular={self.specular}, exponent={self.exponent}]"

    mitsuba.register_bsdf(NAME, Phong)
