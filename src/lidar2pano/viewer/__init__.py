"""What panoramas are looked at with: one self-contained HTML page, a video, a log for Rerun.

page          PageWriter: frames in, one HTML file out; its HTML, CSS, JavaScript and shaders lie in web/.
layers        how the layers of a frame are coded as images.
saved_frames  frames of panoramas that were saved as PNG.
outputs       what `translate` writes about all of its scans together.
"""
