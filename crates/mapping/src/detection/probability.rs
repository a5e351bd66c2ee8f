//! Rasters of probabilities.

use nalgebra::Vector2;

/// Probabilities on a raster, in steps of 1/65535. Row by row; pixel centres at whole numbers.
#[derive(Debug, Clone)]
pub struct ProbabilityMap {
    width: usize,
    height: usize,
    values: Vec<u16>,
}

impl ProbabilityMap {
    const ONE: f32 = 65_535.0;

    /// All nought, `width` x `height` pixels.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, values: vec![0; width * height] }
    }

    /// The raster of `f(x, y)`, clamped to 0..1; what is no number counts as nought.
    pub fn from_fn(width: usize, height: usize, f: impl Fn(usize, usize) -> f32) -> Self {
        let mut map = Self::new(width, height);
        for y in 0..height {
            for (x, value) in map.row_mut(y).iter_mut().enumerate() {
                *value = Self::pack(f(x, y));
            }
        }
        map
    }

    pub fn width(&self) -> usize {
        self.width
    }

    pub fn height(&self) -> usize {
        self.height
    }

    /// The probability at a pixel, 0 to 1.
    pub fn get(&self, x: usize, y: usize) -> f32 {
        f32::from(self.values[y * self.width + x]) / Self::ONE
    }

    /// The probability between pixels, bilinear; the edge's beyond it, nought on an empty raster.
    pub fn at(&self, place: Vector2<f64>) -> f64 {
        if self.values.is_empty() {
            return 0.0;
        }
        let split = |value: f64, length: usize| {
            let value = value.clamp(0.0, (length - 1) as f64);
            let below = (value as usize).min(length.saturating_sub(2));
            (below, (below + 1).min(length - 1), value - below as f64)
        };
        let (x0, x1, fx) = split(place.x, self.width);
        let (y0, y1, fy) = split(place.y, self.height);
        let row = |y: usize| f64::from(self.get(x0, y)) * (1.0 - fx) + f64::from(self.get(x1, y)) * fx;
        row(y0) * (1.0 - fy) + row(y1) * fy
    }

    /// A probability as it is stored: clamped to 0..1; what is no number becomes nought.
    pub fn pack(value: f32) -> u16 {
        // The cast takes NaN to nought and clamps.
        (value * Self::ONE + 0.5) as u16
    }

    /// A row as it is stored.
    pub fn row(&self, y: usize) -> &[u16] {
        &self.values[y * self.width..(y + 1) * self.width]
    }

    /// A row as it is stored, to be filled with what [`Self::pack`] gives.
    pub fn row_mut(&mut self, y: usize) -> &mut [u16] {
        &mut self.values[y * self.width..(y + 1) * self.width]
    }

    /// The largest stored value that is not above the probability `threshold`.
    pub fn level(threshold: f32) -> u16 {
        (threshold * Self::ONE) as u16
    }
}
