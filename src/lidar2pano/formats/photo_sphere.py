"""Photo-sphere metadata: GPano XMP, by which viewers know a panorama and its part of the sphere, in image files.

Google's "Photo Sphere XMP Metadata"; XMP specification, part 3 (JPEG: an APP1 segment, PNG: an iTXt chunk).
"""

from __future__ import annotations

import struct

from lidar2pano.views import FULL_TURN, View

PNG_KEYWORD = b"XML:com.adobe.xmp"
JPEG_NAMESPACE = b"http://ns.adobe.com/xap/1.0/\0"
PACKET = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"
{fields}/>
</rdf:RDF>
</x:xmpmeta>
<?xpacket end="r"?>"""


def gpano(view: View) -> bytes:
    """Return the XMP packet of an equirectangular image, the part of a full sphere that `view` (a sphere) is."""
    if view.kind != "sphere":
        raise ValueError("a photo sphere's rows are equal steps of elevation")
    step = (view.left - view.right) / view.columns
    width = round(FULL_TURN / step)
    fields = {
        "UsePanoramaViewer": "True",
        "ProjectionType": "equirectangular",
        "FullPanoWidthPixels": width,
        "FullPanoHeightPixels": width // 2,
        "CroppedAreaImageWidthPixels": view.columns,
        "CroppedAreaImageHeightPixels": view.rows,
        "CroppedAreaLeftPixels": round((FULL_TURN / 2 - view.left) / step),
        "CroppedAreaTopPixels": round((90 - view.up) / step),
    }
    return PACKET.format(fields="\n".join(f'GPano:{name}="{value}"' for name, value in fields.items())).encode()


def png_chunk_data(xmp: bytes) -> bytes:
    """Return the data of the iTXt chunk with an XMP packet: not compressed, without language and translated keyword."""
    return PNG_KEYWORD + b"\0\0\0\0\0" + xmp


def jpeg_segment(xmp: bytes) -> bytes:
    """Return the APP1 segment with an XMP packet."""
    content = JPEG_NAMESPACE + xmp
    return b"\xff\xe1" + struct.pack(">H", len(content) + 2) + content
