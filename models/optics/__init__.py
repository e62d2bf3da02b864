"""Camera models: from a point in space to a pixel.

Offers weak perspective with its closed-form camera (`weak_perspective`) and perspective lenses with
derivatives (`lenses`).
"""
