//! A piece as a lattice in space: what its boxes say of it while the cameras stand as they are.
//!
//! Every box gives two equations that are linear in the lattice (the rays of its centre), so a piece is one normal matrix.
//! Counting columns and rows from elsewhere is a linear substitution: pieces under a shift of whole columns and rows add up
//! without touching a box again.

use super::LocatedPiece;
use crate::reconstruction::Shot;
use nalgebra::{Matrix2x3, Matrix3, Matrix4, SMatrix, SVector, Vector2, Vector3};

/// Numbers of a lattice: origin, step along the row, step across it, bend.
pub(super) const PARAMS: usize = 12;
/// The bend is counted in units of this share of the squared column.
const BEND_UNIT: f64 = 0.01;

pub(super) type LatticeVector = SVector<f64, PARAMS>;
pub(super) type LatticeMatrix = SMatrix<f64, PARAMS, PARAMS>;

/// How much each vector of a lattice counts at a column and row.
fn factors(col: f64, row: f64) -> [f64; 4] {
    [1.0, col, row, BEND_UNIT * col * col]
}

/// `position = origin + col step_col + row step_row + 0.01 col^2 bend`, metres, in the frame of the reconstruction.
#[derive(Debug, Clone, Copy)]
pub(super) struct Lattice(pub(super) LatticeVector);

impl Lattice {
    pub(super) fn new(origin: Vector3<f64>, step_col: Vector3<f64>, step_row: Vector3<f64>) -> Self {
        let mut terms = LatticeVector::zeros();
        terms.fixed_rows_mut::<3>(0).copy_from(&origin);
        terms.fixed_rows_mut::<3>(3).copy_from(&step_col);
        terms.fixed_rows_mut::<3>(6).copy_from(&step_row);
        Self(terms)
    }

    fn term(&self, index: usize) -> Vector3<f64> {
        self.0.fixed_rows::<3>(3 * index).into_owned()
    }

    pub(super) fn position(&self, col: f64, row: f64) -> Vector3<f64> {
        factors(col, row).iter().enumerate().map(|(k, factor)| self.term(k) * *factor).sum()
    }

    /// Step to the next column at a column, metres.
    pub(super) fn step_col(&self, col: f64) -> Vector3<f64> {
        self.term(1) + self.term(3) * (2.0 * BEND_UNIT * col)
    }

    /// Step to the next row, metres.
    pub(super) fn step_row(&self) -> Vector3<f64> {
        self.term(2)
    }
}

/// Normal equations of a lattice: `matrix * lattice = rhs`; `constant` is the weighted sum of squares at the zero lattice.
#[derive(Debug, Clone)]
pub(super) struct LatticeNormal {
    pub(super) matrix: LatticeMatrix,
    pub(super) rhs: LatticeVector,
    pub(super) constant: f64,
    /// Equations in it.
    pub(super) count: usize,
}

impl LatticeNormal {
    pub(super) fn zero() -> Self {
        Self { matrix: LatticeMatrix::zeros(), rhs: LatticeVector::zeros(), constant: 0.0, count: 0 }
    }

    /// Adds the two equations of a ray seen at a column and row.
    pub(super) fn add_ray(&mut self, col: f64, row: f64, ray: &Ray) {
        let square = ray.by_point.tr_mul(&ray.by_point);
        let down = ray.by_point.tr_mul(&ray.value);
        let factors = factors(col, row);
        for i in 0..4 {
            for j in 0..4 {
                let mut block = self.matrix.fixed_view_mut::<3, 3>(3 * i, 3 * j);
                block += square * (factors[i] * factors[j]);
            }
            let mut block = self.rhs.fixed_rows_mut::<3>(3 * i);
            block += down * factors[i];
        }
        self.constant += ray.value.norm_squared();
        self.count += 2;
    }

    /// Adds `gradient . lattice = value` with a weight.
    pub(super) fn add_equation(&mut self, gradient: &LatticeVector, value: f64, weight: f64) {
        self.matrix += gradient * gradient.transpose() * weight;
        self.rhs += gradient * (value * weight);
        self.constant += weight * value * value;
    }

    /// Adds `vector of lattice = value`, each coordinate with the same weight.
    pub(super) fn add_vector(&mut self, term: usize, value: &Vector3<f64>, weight: f64) {
        for axis in 0..3 {
            self.matrix[(3 * term + axis, 3 * term + axis)] += weight;
            self.rhs[3 * term + axis] += weight * value[axis];
        }
        self.constant += weight * value.norm_squared();
    }

    /// Adds a piece whose columns and rows are those of this lattice plus `(cols, rows)`.
    pub(super) fn add_shifted(&mut self, other: &Self, cols: f64, rows: f64) {
        let by = Matrix4::new(
            1.0,
            0.0,
            0.0,
            0.0, //
            -cols,
            1.0,
            0.0,
            0.0, //
            -rows,
            0.0,
            1.0,
            0.0, //
            BEND_UNIT * cols * cols,
            -2.0 * BEND_UNIT * cols,
            0.0,
            1.0,
        );
        let mut half = LatticeMatrix::zeros();
        for i in 0..4 {
            for k in 0..4 {
                if by[(i, k)] != 0.0 {
                    let mut rows = half.fixed_rows_mut::<3>(3 * i);
                    rows += other.matrix.fixed_rows::<3>(3 * k) * by[(i, k)];
                    let mut rhs = self.rhs.fixed_rows_mut::<3>(3 * i);
                    rhs += other.rhs.fixed_rows::<3>(3 * k) * by[(i, k)];
                }
            }
        }
        for i in 0..4 {
            for k in 0..4 {
                if by[(i, k)] != 0.0 {
                    let mut cols = self.matrix.fixed_columns_mut::<3>(3 * i);
                    cols += half.fixed_columns::<3>(3 * k) * by[(i, k)];
                }
            }
        }
        self.constant += other.constant;
        self.count += other.count;
    }

    /// The lattice, its covariance and the weighted sum of squares that is left; `None` where it is not determined.
    pub(super) fn solve(&self) -> Option<(Lattice, LatticeMatrix, f64)> {
        let cholesky = self.matrix.cholesky()?;
        let solution = cholesky.solve(&self.rhs);
        let left = (self.constant - self.rhs.dot(&solution)).max(0.0);
        solution.iter().all(|value| value.is_finite()).then(|| (Lattice(solution), cholesky.inverse(), left))
    }

    /// As [`Self::solve`] without the covariance.
    pub(super) fn solve_alone(&self) -> Option<(Lattice, f64)> {
        let solution = self.matrix.cholesky()?.solve(&self.rhs);
        let left = (self.constant - self.rhs.dot(&solution)).max(0.0);
        solution.iter().all(|value| value.is_finite()).then_some((Lattice(solution), left))
    }
}

/// The equations of one ray: `by_point * position = value`, in standard deviations of the pixel.
pub(super) struct Ray {
    by_point: Matrix2x3<f64>,
    value: Vector2<f64>,
}

impl Ray {
    /// The ray of a pixel with a standard deviation in pixels, to a point about `depth_m` away along the optical axis.
    pub(super) fn new(shot: &Shot, pixel: Vector2<f64>, depth_m: f64, sigma_px: f64) -> Self {
        let seen = shot.camera.normalised_from_pixel(pixel);
        let rotation = shot.pose.camera_from_world.matrix();
        let translation = shot.pose.translation_m;
        let weight = shot.camera.focal_px() / (depth_m.max(0.1) * sigma_px);
        let row = |axis: usize| (rotation.row(2) * seen[axis] - rotation.row(axis)) * weight;
        let value = |axis: usize| (translation[axis] - seen[axis] * translation.z) * weight;
        Self { by_point: Matrix2x3::from_rows(&[row(0), row(1)]), value: Vector2::new(value(0), value(1)) }
    }
}

/// Where a piece stands by its boxes, the pitch of its type and its surroundings.
#[derive(Debug, Clone)]
pub struct PieceLattice {
    pub(super) lattice: Lattice,
    covariance: LatticeMatrix,
    /// Column and row of the piece at which the lattice's are zero.
    pub(super) origin: [f64; 2],
    /// Which type of bench.
    pub(super) kind: usize,
}

impl PieceLattice {
    pub(super) fn new(lattice: Lattice, covariance: LatticeMatrix, origin: [f64; 2], kind: usize) -> Self {
        Self { lattice, covariance, origin, kind }
    }

    /// Position of a column and row of the piece, metres.
    pub(super) fn position(&self, col: f64, row: f64) -> Vector3<f64> {
        self.lattice.position(col - self.origin[0], row - self.origin[1])
    }

    /// Covariance of that position, square metres.
    pub(super) fn covariance(&self, col: f64, row: f64) -> Matrix3<f64> {
        let factors = factors(col - self.origin[0], row - self.origin[1]);
        let mut sum = Matrix3::zeros();
        for i in 0..4 {
            for j in 0..4 {
                sum += self.covariance.fixed_view::<3, 3>(3 * i, 3 * j) * (factors[i] * factors[j]);
            }
        }
        sum
    }

    /// The same for a piece that begins at another column of this one.
    pub(super) fn starting_at(&self, col: i32) -> Self {
        let mut moved = self.clone();
        moved.origin[0] -= f64::from(col);
        moved
    }
}

/// The normal equations of a piece's boxes, columns and rows counted from its middle, robustly weighted by how far each box
/// lies off a lattice.
pub(super) fn normal_of(
    piece: &LocatedPiece,
    shot: &Shot,
    about: Option<&Lattice>,
    sigma_px: f64,
    shared_px: f64,
) -> LatticeNormal {
    let origin = middle(piece);
    let mut normal = LatticeNormal::zero();
    let boxes = piece.cells.iter().filter(|cell| cell.detection.is_some()).count() as f64;
    for cell in piece.cells.iter().filter(|cell| cell.detection.is_some()) {
        let (col, row) = (f64::from(cell.col) - origin[0], f64::from(cell.row) - origin[1]);
        let position = about.map_or(cell.position_m, |lattice| lattice.position(col, row));
        let in_camera = shot.pose.to_camera(&position);
        let mut sigma = sigma_px;
        if about.is_some()
            && let Some(expected) = shot.camera.project(&in_camera)
        {
            // By Cauchy: beyond three sigma a box counts less and less.
            let off = (expected - cell.center_px).norm_squared() / (sigma_px * sigma_px);
            sigma *= (1.0 + off / 9.0).sqrt();
        }
        // However many boxes there are, their common errors do not average out.
        sigma = (sigma * sigma + shared_px * shared_px * boxes / 4.0).sqrt();
        normal.add_ray(col, row, &Ray::new(shot, cell.center_px, in_camera.z, sigma));
    }
    normal
}

/// Column and row of the middle of a piece.
pub(super) fn middle(piece: &LocatedPiece) -> [f64; 2] {
    [f64::from(piece.cols - 1) / 2.0, f64::from(piece.rows - 1) / 2.0]
}
