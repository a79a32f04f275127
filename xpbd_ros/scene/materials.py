"""
Materials: density, membrane stiffness and bending stiffness of fabrics.

The fabrics are those that Wang, O'Brien and Ramamoorthi measured (Data-driven elastic models for
cloth, ACM Trans. Graph. 30(4), 2011), from the files that come with ARCSim. Their stiffness grows
with strain and depends on its direction, which a single modulus does not express. The values here
are for a strip stretched by 1/6: C11 pulled along warp, C22 along weft, C12 the mean of both, and
the shear modulus at 45° (half of the fourth number, which multiplies the tensor's strain). The
bending stiffness is the mean of warp, weft and 45° at the smallest curvature. Paper has the
nominal values of ARCSim's file.

The effect ``membrane`` takes all of these values. A lattice of edges cannot (doc/numerics.md 5.2):
with square cells it has C12 = C66, with oblong ones C12 = 0, so Poisson's ratio is not free. A
lattice keeps the moduli of a strip pulled along warp and along weft, and the shear modulus. At
small strains a knit is softer than these values, by up to a factor of 10.
"""

from dataclasses import dataclass
from math import sqrt
from typing import Any, NamedTuple

from xpbd_ros.errors import InputError
from xpbd_ros.scene.read import mapping, read, unknown
from xpbd_ros.sim.parameters import quantity


class Sheet(NamedTuple):
    """A thin elastic sheet: membrane σ = C ε with γ = 2 ε12 for shear, and bending."""

    density: float
    """[kg/m²]"""
    c11: float
    """along warp [N/m]"""
    c12: float
    """[N/m]"""
    c22: float
    """along weft [N/m]"""
    shear: float
    """C66 [N/m]"""
    bend: float
    """bending rigidity [N m]"""


MATERIALS = {
    'denim': Sheet(0.324, 232.0, 40.8, 1051.6, 42.0, 78.2e-6),
    'interlock': Sheet(0.187, 46.4, 69.8, 405.9, 22.1, 20.7e-6),
    'rib_knit': Sheet(0.276, 52.4, 3.8, 254.6, 13.8, 36.2e-6),
    'ponte': Sheet(0.284, 78.7, 38.2, 191.8, 22.3, 35.5e-6),
    'tablecloth': Sheet(0.128, 2107.2, 48.8, 2150.5, 50.7, 41.2e-6),
    'trousers': Sheet(0.220, 2109.5, 51.0, 2152.7, 60.7, 119.6e-6),
    'blanket': Sheet(0.228, 164.1, 44.2, 359.8, 64.8, 88.1e-6),
    'jacket': Sheet(0.113, 75.2, 30.2, 404.9, 20.7, 18.9e-6),
    'swimsuit': Sheet(0.204, 40.4, 31.6, 124.5, 18.0, 56.7e-6),
    'paper': Sheet(0.1, 0.5e6, 0.0, 0.5e6, 0.25e6, 0.4e-3),
}
"""fabrics by name"""


@dataclass(frozen=True)
class Isotropic:
    """A sheet of an isotropic solid."""

    young: float = quantity(unit='Pa', above=0.0, doc="Young's modulus")
    poisson: float = quantity(above=-1.0, maximum=0.5, doc="Poisson's ratio")
    thickness: float = quantity(unit='m', above=0.0, doc='of the sheet')
    density: float = quantity(unit='kg/m³', above=0.0, doc='of the solid')


INSTEAD = {'stretch': {'compliance'}, 'membrane': {'young'}, 'hinge': {'warp', 'weft'}}
"""by effect, the keys with which it takes no value from the material"""


def sheet_of(solid: Isotropic) -> Sheet:
    """Return the sheet that a solid of a given thickness makes, by plate theory."""
    plane = solid.young * solid.thickness / (1.0 - solid.poisson**2)
    return Sheet(solid.density * solid.thickness, plane, solid.poisson * plane, plane,
                 0.5 * (1.0 - solid.poisson) * plane, plane * solid.thickness**2 / 12.0)


def pulled(sheet: Sheet) -> tuple[float, float]:
    """Return the moduli of a strip pulled along warp and along weft, free at its sides [N/m]."""
    return (sheet.c11 - sheet.c12**2 / sheet.c22, sheet.c22 - sheet.c12**2 / sheet.c11)


def lattice(sheet: Sheet, *, shears: bool) -> dict[str, dict[str, float]]:
    """
    Return {effect: {parameter: value}} of a lattice of edges that matches a sheet.

    Its moduli along warp and weft and its shear modulus match; Poisson's ratio does not.

    Parameters
    ----------
    sheet : the material
    shears : whether the cloth has diagonals of square cells, which add C66 to C11, C12 and C22

    With diagonals, C11 C22 - C66² = Y1 C22 = Y2 C11 gives the C11 and C22 of the lattice.

    """
    warp, weft = pulled(sheet)
    if shears:
        ratio = warp / weft
        c22 = 0.5 * (weft + sqrt(weft**2 + 4.0 * sheet.shear**2 / ratio))
        warp, weft = ratio * c22 - sheet.shear, c22 - sheet.shear
    return {'stretch': {'warp': warp, 'weft': weft}, 'shear': {'stiffness': sheet.shear},
            'bend': {'stiffness': sheet.bend}}


def membrane(sheet: Sheet) -> dict[str, float]:
    """Return {parameter: value} of the effect ``membrane``."""
    warp, weft = pulled(sheet)
    return {'warp': warp, 'weft': weft, 'shear': sheet.shear, 'poisson': sheet.c12 / sheet.c22}


def with_material(cloth: Any, path: str, *, square: bool) -> Any:
    """
    Return a cloth's mapping with values from its material where it gives none.

    They are the density, and the parameters of the effects that the cloth names; other effects
    stay absent. ``square`` is whether the cloth is a grid with square cells.
    """
    if not isinstance(cloth, dict) or cloth.get('material') is None:
        return cloth
    sheet = _sheet(cloth['material'], f'{path}.material')
    effects = mapping(cloth.get('effects'), f'{path}.effects')
    filled = dict(effects)
    for effect, values in {**lattice(sheet, shears=square and 'shear' in effects),
                           'membrane': membrane(sheet),
                           'hinge': {'stiffness': sheet.bend}}.items():
        given = mapping(effects.get(effect), f'{path}.effects.{effect}')
        if effect not in effects or INSTEAD.get(effect, set()) & set(given):
            continue
        filled[effect] = {**values, **given}
    known = {'density': sheet.density, **cloth}
    return {**known, 'effects': filled} if 'effects' in cloth else known


def _sheet(material: Any, path: str) -> Sheet:
    if isinstance(material, dict):
        return sheet_of(read(Isotropic, material, path))
    if not isinstance(material, str) or material not in MATERIALS:
        raise InputError(f'{path}: {unknown(material, MATERIALS, "material")}; or give young '
                         '(Pa), poisson, thickness (m) and density (kg/m³)')
    return MATERIALS[material]
