"""Place recognition: candidates by an inverted index, then verification of their geometry. Its modules:

index                keyframes that share words with one; `keyframe_views` holds views and images
verification         the relative pose by descriptors, or why there is none (`refinement`, `depth_scale`)
patch_alignment      that pose, or the map's, to a tenth of a pixel
"""
