"""An Asset Administration Shell of a node: Digital Nameplate (IDTA 02006-3-0) and Technical Data (IDTA 02003-1-2).

Nameplate fields come from the Meta-Identification TEDS, technical data from the channels. Semantic ids are those of
the published templates. basyx-python-sdk (extra ``aas``) builds and checks the objects.
"""

from __future__ import annotations

import io
import json
import math
from typing import TYPE_CHECKING, Any, Final

from teds_provision.describe.described_node import DescribedNode
from teds_provision.errors import UsageError
from teds_provision.lazy import how_to_install
from teds_provision.teds.channel import Channel

if TYPE_CHECKING:
    from basyx.aas import model

FORM: Final = "The Digital Nameplate"
_NAMEPLATE: Final = "https://admin-shell.io/idta/nameplate/3/0/Nameplate"
_ADDRESS: Final = "https://admin-shell.io/zvei/nameplate/1/0/ContactInformations/AddressInformation"
_TECHNICAL: Final = "https://admin-shell.io/ZVEI/TechnicalData/Submodel/1/2"
_GENERAL: Final = "https://admin-shell.io/ZVEI/TechnicalData/GeneralInformation/1/1"
_PROPERTIES: Final = "https://admin-shell.io/ZVEI/TechnicalData/TechnicalProperties/1/1"
_SECTION: Final = "https://admin-shell.io/ZVEI/TechnicalData/MainSection/1/1"

# idShort, semantic id, element of the Meta-Identification TEDS, True for text with a language, True if mandatory
_FIELDS: Final = (
    ("URIOfTheProduct", "0112/2///61987#ABN590#002", "ProductUri", False, True),
    ("ManufacturerName", "0112/2///61987#ABA565#009", "ManufacturerId", True, True),
    ("ManufacturerProductDesignation", "0112/2///61987#ABA567#009", "ProductDescription", True, True),
    ("OrderCodeOfManufacturer", "0112/2///61987#ABA950#008", "OrderCode", False, True),
    ("ManufacturerProductType", "0112/2///61987#ABA300#008", "ModelNo", False, False),
    ("ProductArticleNumberOfManufacturer", "0112/2///61987#ABA581#007", "ArticleNo", False, False),
    ("SerialNumber", "0112/2///61987#ABA951#009", "SerialNo", False, False),
    ("HardwareVersion", "0112/2///61987#ABA926#008", "VersionCode", False, False),
)
_ADDRESS_FIELDS: Final = (
    ("Street", "0173-1#02-AAO128#002", "Street"),
    ("Zipcode", "0173-1#02-AAO129#002", "ZipCode"),
    ("CityTown", "0173-1#02-AAO132#002", "CityTown"),
    ("NationalCode", "0173-1#02-AAO134#002", "NationalCode"),
)


def asset_shell(node: DescribedNode) -> str:
    """Return the environment (shell and two submodels) as JSON of AAS metamodel 3; equal input gives equal octets.

    Raises MissingFieldError for a mandatory field without a value, UsageError if basyx-python-sdk is missing.
    """
    try:
        from basyx.aas import model
        from basyx.aas.adapter.json import write_aas_json_file
    except ImportError as error:
        raise UsageError(
            "An Asset Administration Shell needs the package basyx-python-sdk.",
            hint=how_to_install("aas"),
        ) from error
    uuid = node.uuid.hex()
    shells = _Shells(model)
    nameplate = model.Submodel(f"urn:teds:{uuid}:nameplate", shells.nameplate(node), id_short="Nameplate")
    nameplate.semantic_id = shells.reference(_NAMEPLATE)
    technical = model.Submodel(f"urn:teds:{uuid}:technical-data", shells.technical(node), id_short="TechnicalData")
    technical.semantic_id = shells.reference(_TECHNICAL)
    shell = model.AssetAdministrationShell(
        model.AssetInformation(model.AssetKind.INSTANCE, global_asset_id=f"urn:teds:{uuid}"),
        f"urn:teds:{uuid}:shell",
        id_short=f"Node_{uuid}",
        submodel={model.ModelReference.from_referable(submodel) for submodel in (nameplate, technical)},
    )
    written = io.StringIO()
    write_aas_json_file(written, model.DictIdentifiableStore([shell, nameplate, technical]))
    return json.dumps(_sorted(json.loads(written.getvalue())), ensure_ascii=False, indent=1) + "\n"


class _Shells:
    """Makes the elements with basyx's classes, which are loaded late."""

    def __init__(self, model: Any) -> None:
        self._model = model

    def reference(self, value: str) -> model.ExternalReference:
        """Return a reference to a concept outside of the shell."""
        key = self._model.Key(self._model.KeyTypes.GLOBAL_REFERENCE, value)
        reference: model.ExternalReference = self._model.ExternalReference((key,))
        return reference

    def nameplate(self, node: DescribedNode) -> list[model.SubmodelElement]:
        """Return the elements of the nameplate, in the order of the template."""
        found: list[model.SubmodelElement] = []
        for name, semantic, element, in_language, mandatory in _FIELDS:
            if mandatory or node.nameplate.get(element.lower()):
                value = node.identification(FORM, name, element)
                uri = self._model.datatypes.AnyURI if name == "URIOfTheProduct" else str
                found.append(self._text(name, semantic, value) if in_language else self._of(name, semantic, uri(value)))
        address = [
            self._text(name, semantic, node.identification(FORM, f"AddressInformation/{name}", element))
            for name, semantic, element in _ADDRESS_FIELDS
        ]
        return [*found, self._collection("AddressInformation", _ADDRESS, address)]

    def technical(self, node: DescribedNode) -> list[model.SubmodelElement]:
        """Return general information and a section for each channel, values in SI units."""
        general = [
            self._of(
                "ManufacturerName",
                "0173-1#02-AAO677#002",
                node.identification(FORM, "ManufacturerName", "ManufacturerId"),
            ),
            self._text(
                "ManufacturerProductDesignation",
                "0173-1#02-AAW338#001",
                node.identification(FORM, "ManufacturerProductDesignation", "ProductDescription"),
            ),
            self._of(
                "ManufacturerArticleNumber",
                "0173-1#02-AAO676#003",
                node.identification("Technical Data", "ManufacturerArticleNumber", "ArticleNo"),
            ),
            self._of(
                "ManufacturerOrderCode",
                "0173-1#02-AAO227#002",
                node.identification(FORM, "ManufacturerOrderCode", "OrderCode"),
            ),
        ]
        sections = [self._section(channel) for channel in node.sheet.channels]
        return [
            self._collection("GeneralInformation", _GENERAL, general),
            self._collection("TechnicalProperties", _PROPERTIES, sections),
        ]

    def _section(self, channel: Channel) -> model.SubmodelElement:
        kind = channel.kind.name.lower().replace("_", " ") if channel.kind is not None else "unknown"
        values: list[model.SubmodelElement] = [
            self._of("Name", None, channel.name or f"channel {channel.number}"),
            self._of("Kind", None, kind),
            self._of("Unit", None, channel.si_unit),
        ]
        numbers = {
            "LowLimit": channel.low,
            "HighLimit": channel.high,
            "Uncertainty": channel.stated_uncertainty,
            "SamplingPeriod": channel.period,
        }
        values += [self._of(name, None, value) for name, value in numbers.items() if math.isfinite(value)]
        dates = {"CalibrationDate": channel.calibrated_at, "CalibrationDue": channel.due}
        values += [self._of(name, None, moment.date().isoformat()) for name, moment in dates.items() if moment]
        return self._collection(f"Channel{channel.number}", _SECTION, values)

    def _collection(self, name: str, semantic: str, elements: list[model.SubmodelElement]) -> model.SubmodelElement:
        made: model.SubmodelElement = self._model.SubmodelElementCollection(
            name, elements, semantic_id=self.reference(semantic)
        )
        return made

    def _text(self, name: str, semantic: str, value: str) -> model.SubmodelElement:
        texts = self._model.MultiLanguageTextType({"en": value})
        made: model.SubmodelElement = self._model.MultiLanguageProperty(
            name, texts, semantic_id=self.reference(semantic)
        )
        return made

    def _of(self, name: str, semantic: str | None, value: object) -> model.SubmodelElement:
        kind = self._model.datatypes.Double if isinstance(value, float) else type(value)
        kind = self._model.datatypes.String if kind is str else kind
        made: model.SubmodelElement = self._model.Property(
            name, kind, value, semantic_id=self.reference(semantic) if semantic else None
        )
        return made


def _sorted(value: Any) -> Any:
    """Sort what basyx writes in the order of a set, so that equal datasheets give equal files."""
    if isinstance(value, dict):
        return {key: _sorted(value[key]) for key in sorted(value)}
    if isinstance(value, list):
        return sorted((_sorted(part) for part in value), key=lambda part: json.dumps(part, sort_keys=True))
    return value
