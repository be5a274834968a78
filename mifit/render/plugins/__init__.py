"""Mitsuba plugins, one per file; each file's ``make`` defines the class for the variant that is active.

A class derived from a Mitsuba base belongs to the variant in which it was defined: under another one it would register
without an error and misbehave. So the classes are made once per variant.
"""

from __future__ import annotations

from mifit.appearance.arrays import mi

_CLASSES: dict[str, dict[str, type]] = {}


def register_plugins() -> dict[str, type]:
    """Classes of ``blinnphong``, ``shenv``, ``shdirect`` and ``pinhole`` by name, registered with the current variant.

    Harmless to repeat. VariantError where no variant is active.
    """
    from mifit.errors import VariantError
    from mifit.render.plugins import blinnphong, pinhole, shdirect, shenv

    variant = mi.variant()
    if variant is None:
        raise VariantError("no Mitsuba variant is active; call mifit.set_variant() first")
    if variant not in _CLASSES:
        plugins = {"blinnphong": blinnphong, "shenv": shenv, "shdirect": shdirect, "pinhole": pinhole}
        made = {name: plugin.make() for name, plugin in plugins.items()}
        mi.register_bsdf("blinnphong", made["blinnphong"])
        mi.register_emitter("shenv", made["shenv"])
        mi.register_integrator("shdirect", made["shdirect"])
        mi.register_sensor("pinhole", made["pinhole"])
        _CLASSES[variant] = made
    return _CLASSES[variant]
