//! WGS84 geodesy: longitude, latitude and height, earth-centred coordinates, and the local east-north-up frame that
//! structure from motion works in.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

const SEMI_MAJOR_M: f64 = 6_378_137.0;
const SEMI_MINOR_M: f64 = 6_356_752.314245;
const ECCENTRICITY_SQUARED: f64 = 1.0 - (SEMI_MINOR_M * SEMI_MINOR_M) / (SEMI_MAJOR_M * SEMI_MAJOR_M);

/// A geodetic position on WGS84: degrees, and metres of height in whatever vertical datum the source wrote.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Lla {
    pub latitude_deg: f64,
    pub longitude_deg: f64,
    pub height_m: f64,
}

impl Lla {
    /// Earth-centred, earth-fixed coordinates in metres.
    pub fn to_ecef(self) -> Vector3<f64> {
        let (sin_lat, cos_lat) = self.latitude_deg.to_radians().sin_cos();
        let (sin_lon, cos_lon) = self.longitude_deg.to_radians().sin_cos();
        let prime_vertical_m = SEMI_MAJOR_M / (1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat).sqrt();
        Vector3::new(
            (prime_vertical_m + self.height_m) * cos_lat * cos_lon,
            (prime_vertical_m + self.height_m) * cos_lat * sin_lon,
            (prime_vertical_m * (1.0 - ECCENTRICITY_SQUARED) + self.height_m) * sin_lat,
        )
    }

    /// The geodetic position of earth-centred coordinates in metres (Bowring's start, then Newton steps; exact to well
    /// below a millimetre anywhere near the surface).
    pub fn from_ecef(ecef: Vector3<f64>) -> Self {
        let longitude = ecef.y.atan2(ecef.x);
        let distance_to_axis = ecef.x.hypot(ecef.y);
        let mut latitude = ecef.z.atan2(distance_to_axis * (1.0 - ECCENTRICITY_SQUARED));
        let mut height = 0.0;
        for _ in 0..6 {
            let (sin_lat, cos_lat) = latitude.sin_cos();
            let prime_vertical_m = SEMI_MAJOR_M / (1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat).sqrt();
            height = if cos_lat.abs() > 0.1 {
                distance_to_axis / cos_lat - prime_vertical_m
            } else {
                ecef.z / sin_lat - prime_vertical_m * (1.0 - ECCENTRICITY_SQUARED)
            };
            latitude = ecef.z.atan2(
                distance_to_axis * (1.0 - ECCENTRICITY_SQUARED * prime_vertical_m / (prime_vertical_m + height)),
            );
        }
        Self { latitude_deg: latitude.to_degrees(), longitude_deg: longitude.to_degrees(), height_m: height }
    }
}

/// The origin of a local frame with x east, y north and z up, in metres (a tangent plane, not a flat earth).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GeodeticReference {
    pub origin: Lla,
}

impl GeodeticReference {
    /// A frame about `origin`.
    pub fn new(origin: Lla) -> Self {
        Self { origin }
    }

    /// Rows are the east, north and up axes in earth-centred coordinates.
    fn enu_from_ecef_rotation(&self) -> Matrix3<f64> {
        let (sin_lat, cos_lat) = self.origin.latitude_deg.to_radians().sin_cos();
        let (sin_lon, cos_lon) = self.origin.longitude_deg.to_radians().sin_cos();
        Matrix3::new(
            -sin_lon,
            cos_lon,
            0.0,
            -sin_lat * cos_lon,
            -sin_lat * sin_lon,
            cos_lat,
            cos_lat * cos_lon,
            cos_lat * sin_lon,
            sin_lat,
        )
    }

    /// East, north, up in metres of a geodetic position.
    pub fn enu_from_lla(&self, position: Lla) -> Vector3<f64> {
        self.enu_from_ecef_rotation() * (position.to_ecef() - self.origin.to_ecef())
    }

    /// The geodetic position of a point given east, north, up in metres.
    pub fn lla_from_enu(&self, enu_m: Vector3<f64>) -> Lla {
        Lla::from_ecef(self.origin.to_ecef() + self.enu_from_ecef_rotation().transpose() * enu_m)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn one_degree_of_latitude_is_about_111_km() {
        let reference = GeodeticReference::new(Lla { latitude_deg: 49.8, longitude_deg: 14.0, height_m: 0.0 });
        let north = reference.enu_from_lla(Lla { latitude_deg: 49.801, longitude_deg: 14.0, height_m: 0.0 });
        assert!((north.y - 111.23).abs() < 0.05, "{north}");
        assert!(north.x.abs() < 1e-6);
    }

    proptest! {
        #[test]
        fn local_coordinates_round_trip(
            latitude_deg in -89.0..89.0_f64, longitude_deg in -180.0..180.0_f64, height_m in -100.0..5000.0_f64,
            x in -5000.0..5000.0_f64, y in -5000.0..5000.0_f64, z in -200.0..500.0_f64,
        ) {
            let reference = GeodeticReference::new(Lla { latitude_deg, longitude_deg, height_m });
            let enu_m = Vector3::new(x, y, z);
            let back = reference.enu_from_lla(reference.lla_from_enu(enu_m));
            prop_assert!((back - enu_m).norm() < 1e-5, "{} against {}", back, enu_m);
        }
    }
}
