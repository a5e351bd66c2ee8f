//! The parameters of the layout.

/// How benches grow from module to module. Lengths are shares of a module's side or pitch unless another unit is given; values
/// were chosen on rendered and real photos of many plants, where no source is given.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LayoutParams {
    /// A module's neighbours stand this many of its own sides away, from and to; what is further is no neighbour.
    pub neighbour_sides: [f64; 2],
    /// How far aside a neighbour may stand.
    pub neighbour_aside: f64,
    /// Ratio of the sides of two neighbours, from and to, and least cosine between them.
    pub neighbour_ratio: [f64; 2],
    pub neighbour_cosine: f64,
    /// How far a module may stand off its lattice, as a share of the shorter pitch (the paper's RANSAC threshold).
    pub inlier: f64,
    /// Modules from which a lattice is known well enough to find outliers.
    pub inlier_least: usize,
    /// So many modules in a row are a row by themselves, whatever stands about.
    pub long_columns: i32,
    /// Further off than this, columns, no lattice is known well enough to say that another piece stands on it.
    pub torn_reach: f64,
    /// How far off the lattice such a piece may stand, and how much more for each column between.
    pub torn_off: f64,
    pub torn_off_per_column: f64,
    /// How near the frame a module may be seen, as a share of its shorter side, and at least, pixels.
    pub frame_margin: f64,
    pub frame_margin_px: f64,
    /// How much wider than the narrowest gap must be what keeps two parts of one lattice apart, as a factor.
    pub sure_gap: f64,
    /// Ratio of the sides of two parts of one lattice, from and to, and least cosine between them.
    pub part_ratio: [f64; 2],
    pub part_cosine: f64,
    /// How far off the lattice along the row a part may stand, how much more for each column between, and across the row.
    pub part_off: f64,
    pub part_off_per_column: f64,
    pub part_off_row: f64,
    /// From so many pairs on, the sides of their boxes tell how far apart they stand: the sides of one box err more than its
    /// centre.
    pub many_crossings: usize,
    /// How far apart, in pitches along the row, the facing modules of two benches may stand for a gap to be a keypoint. The
    /// paper stops below two (equation 2); wider ones are roads and still tie a line together.
    pub widest_gap: f64,
    /// Ground is this much darker than seams, grey of 0 to 1, and its histogram shares no more than this with theirs; or it
    /// shares still less, whatever its brightness.
    pub ground_darker: f64,
    pub ground_alike: f64,
    pub ground_unlike: f64,
    /// Grey from which a pixel is washed out by glare, 0 to 1.
    pub glare: f64,
    /// Share that the histogram of a module has in common with those of its neighbours.
    pub module_alike: f64,
}

impl Default for LayoutParams {
    fn default() -> Self {
        Self {
            neighbour_sides: [0.75, 1.45],
            neighbour_aside: 0.35,
            neighbour_ratio: [0.65, 1.55],
            neighbour_cosine: 0.85,
            inlier: 0.25,
            inlier_least: 6,
            long_columns: 12,
            torn_reach: 9.0,
            torn_off: 0.12,
            torn_off_per_column: 0.02,
            frame_margin: 0.15,
            frame_margin_px: 4.0,
            sure_gap: 1.2,
            part_ratio: [0.8, 1.25],
            part_cosine: 0.95,
            part_off: 0.15,
            part_off_per_column: 0.02,
            part_off_row: 0.25,
            many_crossings: 4,
            widest_gap: 8.0,
            ground_darker: 0.08,
            ground_alike: 0.6,
            ground_unlike: 0.25,
            glare: 0.93,
            module_alike: 0.5,
        }
    }
}
